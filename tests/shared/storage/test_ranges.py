"""Reading an object by ranges: the bytes are right, and the requests are few."""

import io

import numpy as np
import pytest

from perilune_shared.storage.ranges import Ranges

SIZE = 10_000_000
CONTENT = np.random.default_rng(0).bytes(SIZE)


@pytest.fixture
def opened():
    """The object as a file, and its requests."""
    requests = []

    def read(start, end):
        requests.append((start, end))
        return CONTENT[start:end]

    return Ranges(read, SIZE), requests


def test_any_part_is_read(opened):
    file, _ = opened
    for start in np.random.default_rng(1).integers(0, SIZE, 30):
        for count in (1, 10_000, 5_000_000):
            file.seek(start)
            assert file.read(count) == CONTENT[start : start + count]
            assert file.tell() == min(start + count, SIZE)
    assert file.seek(-10, io.SEEK_END) == SIZE - 10 and file.read() == CONTENT[-10:] and file.read(5) == b""
    assert file.seek(SIZE + 7) == SIZE + 7 and file.read(5) == b""


def test_a_file_is_read_from_start_to_end_by_few_requests(opened):
    file, requests = opened
    chunks = []
    while chunk := file.read(2**20):
        chunks.append(chunk)
    assert b"".join(chunks) == CONTENT and len(requests) == 3


def test_fetched_ranges_need_one_request_each_and_near_ones_one_together(opened):
    file, requests = opened
    with file.fetched([(5_000_000, 6_000_000), (1000, 2000), (2500, 300_000)]):
        assert [start for start, _ in requests] == [1000, 5_000_000]
        for start, end in ((5_000_000, 6_000_000), (1000, 2000), (2500, 300_000), (299_990, 310_000)):
            file.seek(start)
            assert file.read(end - start) == CONTENT[start:end]
        assert len(requests) == 2
    file.seek(5_000_000)
    assert file.read(10) == CONTENT[5_000_000:5_000_010] and len(requests) == 3


def test_the_end_is_kept(opened):
    file, requests = opened
    file.keep(SIZE - 1000)
    with file.fetched([(0, 10)]):
        pass
    for _ in range(3):
        file.seek(SIZE - 500)
        assert file.read(500) == CONTENT[-500:]
    assert len(requests) == 2


@pytest.mark.parametrize("wrong", [(SIZE + 5, SIZE + 50), (50, 10), (-5, 3), (-9, -5)])
def test_ranges_that_a_damaged_footer_states_do_no_harm(opened, wrong):
    file, _ = opened
    with file.fetched([wrong]):
        file.seek(20)
        assert file.read(10) == CONTENT[20:30]
