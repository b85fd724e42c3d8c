"""Items made ahead in a thread."""

import itertools
import threading
import time

import pytest

from perilune_train.data.ahead import Ahead


def numbers(key):
    return itertools.count(key)


class Squares:
    def __init__(self):
        self.begun, self.made = 0, []

    def __call__(self, keys):
        self.begun += 1
        for key in keys:
            if key == 9:
                raise ValueError("nine")
            self.made.append(key)
            yield key, key * key


def test_items_come_in_order_and_at_most_so_many_are_made_ahead():
    make = Squares()
    ahead = Ahead(make, numbers, 2)
    assert [ahead.take(key) for key in (1, 2, 3)] == [1, 4, 9]
    deadline = time.monotonic() + 20
    while len(make.made) < 6 and time.monotonic() < deadline:
        time.sleep(0.001)
    time.sleep(0.05)
    # Two wait, and the thread holds one more.
    assert make.made == [1, 2, 3, 4, 5, 6]
    assert make.begun == 1
    ahead.close()


def test_another_key_than_the_next_begins_again():
    make = Squares()
    ahead = Ahead(make, numbers, 2)
    assert [ahead.take(key) for key in (1, 2, 5, 6, 1)] == [1, 4, 25, 36, 1]
    assert make.begun == 3
    ahead.close()


def test_an_error_is_raised_at_its_item_and_making_can_begin_again():
    ahead = Ahead(Squares(), numbers, 4)
    assert ahead.take(7) == 49
    assert ahead.take(8) == 64
    for _ in range(2):
        with pytest.raises(ValueError, match="nine"):
            ahead.take(9)
    assert ahead.take(10) == 100
    before = threading.active_count()
    ahead.close()
    assert threading.active_count() == before - 1
