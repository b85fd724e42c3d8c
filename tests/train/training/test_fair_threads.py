"""The number of threads follows other work on the machine, by trials of speed."""

import pytest
import torch

from perilune_train.training.fair_threads import FairThreads


class Machine:
    """A clock, the work of others, and how long a step takes with each number of threads."""

    def __init__(self, step_s: dict[int, float]):
        self.now_s, self.others, self.step_s = 0.0, 0.0, step_s

    def run(self, threads: FairThreads, seconds: float) -> list[int]:
        """Numbers of threads of the steps of so many seconds."""
        used, until_s = [], self.now_s + seconds
        while self.now_s < until_s:
            with threads:
                used.append(torch.get_num_threads())
                self.now_s += self.step_s[used[-1]]
            assert torch.get_num_threads() == 4
        return used


@pytest.fixture
def four_threads(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(before)


def started(machine: Machine) -> FairThreads:
    return FairThreads(True, lambda: machine.now_s, lambda: machine.others)


def test_an_idle_machine_keeps_all_threads(four_threads):
    machine = Machine({4: 0.1})
    threads = started(machine)
    assert set(machine.run(threads, 100)) == {4}


def test_fewer_threads_are_used_while_they_are_faster(four_threads):
    machine = Machine({4: 0.4, 3: 0.2})
    threads = started(machine)
    machine.others = 1.0
    machine.run(threads, 10)
    used = machine.run(threads, 200)
    # Trials of all threads take a small part of the time.
    assert set(used) == {3, 4}
    assert used.count(3) > 0.9 * len(used)
    machine.others, machine.step_s = 0.0, {4: 0.1, 3: 0.12}
    machine.run(threads, 5)
    assert set(machine.run(threads, 100)) == {4}


def test_all_threads_stay_where_fewer_are_slower(four_threads):
    machine = Machine({4: 0.1, 2: 0.2})
    threads = started(machine)
    machine.others = 1.5
    used = machine.run(threads, 300)
    assert used.count(4) > 0.9 * len(used)


def test_one_thread_is_the_least(four_threads):
    machine = Machine({4: 0.4, 1: 0.1})
    threads = started(machine)
    machine.others = 30.0
    machine.run(threads, 10)
    assert machine.run(threads, 10)[0] == 1
    assert torch.get_num_threads() == 4


def test_a_number_that_the_program_chooses_later_stays(four_threads):
    machine = Machine({4: 0.4, 3: 0.2})
    threads = started(machine)
    machine.others = 1.0
    machine.run(threads, 10)
    torch.set_num_threads(1)
    for _ in range(1000):
        with threads:
            assert torch.get_num_threads() == 1
            machine.now_s += 0.1
    assert torch.get_num_threads() == 1


def test_a_number_of_the_user_stays(four_threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    machine = Machine({4: 0.1})
    threads = started(machine)
    machine.others = 3.0
    assert set(machine.run(threads, 100)) == {4}
