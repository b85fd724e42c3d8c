"""Number of torch's threads on a CPU, adapted to other work on the machine."""

import math
import time
from collections.abc import Callable

import torch

from perilune_shared.threads import OtherWork, chosen_by_user

_CHECK_S = 2.0
"""Interval at which the work of other processes is read."""
_TRIAL_S, _TRIAL_STEPS = 1.5, 3
"""Least duration and number of steps for which a number of threads is tried."""
_RETRY_S = 20.0
"""Least interval between two trials."""
_QUIET_CORES = 0.2
"""Work of other processes below which all threads are used."""
_GAIN = 1.03
"""Least gain in speed for which the number of threads changes."""


class FairThreads:
    """Chooses torch's number of threads while a loop runs; restores it when the block ends.

    Each operation ends when its slowest thread ends. If another process takes half of one core, all threads of an
    operation therefore run at half speed, and fewer threads are faster. While others use the cores, a trial of some
    steps with fewer threads decides; when they have ended, all threads are used again.

    The number of threads changes the last digits of sums, so two trainings on a busy machine are equal only up to
    rounding. It stays constant on an idle machine, on a GPU, and if OMP_NUM_THREADS is set, which is how to fix it.

    Example:

        with FairThreads() as threads:
            for batch in batches:
                train_on(batch)
                threads.step()
    """

    def __init__(
        self,
        enabled: bool = True,
        clock: Callable[[], float] = time.monotonic,
        others: Callable[[], float] | None = None,
    ):
        """With `enabled` false the number stays; torch computes on a GPU, or several processes share the cores.

        `clock` returns the time, s; `others` the cores that other processes have used since it was last called."""
        self.most = torch.get_num_threads()
        self._active = enabled and self.most > 1 and not chosen_by_user("OMP_NUM_THREADS")
        self._clock, self._others = clock, OtherWork().cores if others is None else others
        self._checked_s = self._tried_s = clock()
        self._tried_s -= _RETRY_S
        self._waiting: list[int] = []
        """Numbers of threads that are still to be tried, the current one first; empty outside a trial."""
        self._speeds: dict[int, float] = {}
        self._n_steps, self._began_s = 0, 0.0
        self._preferred = self.most

    def __enter__(self) -> "FairThreads":
        return self

    def __exit__(self, *_: object) -> None:
        self.restore()

    def restore(self) -> None:
        """Use all threads again."""
        if self._active:
            self._use(self.most)

    def step(self) -> None:
        """Report the end of a step of the loop; may change the number of threads for the next ones."""
        if not self._active:
            return
        now_s = self._clock()
        if self._waiting:
            self._measure(now_s)
        elif now_s - self._checked_s >= _CHECK_S:
            self._check(now_s)

    def _check(self, now_s: float) -> None:
        self._checked_s, others = now_s, self._others()
        if others < _QUIET_CORES:
            self._use(self.most)
            self._preferred = self.most
        elif now_s - self._tried_s >= _RETRY_S:
            fewer = max(1, self.most - math.ceil(others - _QUIET_CORES))
            self._waiting, self._speeds = list(dict.fromkeys([self._preferred, self.most, fewer])), {}
            self._try_next(now_s)

    def _measure(self, now_s: float) -> None:
        self._n_steps += 1
        elapsed_s = now_s - self._began_s
        if self._n_steps < _TRIAL_STEPS or elapsed_s < _TRIAL_S:
            return
        self._speeds[self._waiting.pop(0)] = self._n_steps / elapsed_s
        if self._waiting:
            self._try_next(now_s)
            return
        best = max(self._speeds, key=lambda number: self._speeds[number])
        if self._speeds[best] > _GAIN * self._speeds[self._preferred]:
            self._preferred = best
        self._use(self._preferred)
        self._checked_s = self._tried_s = now_s
        # What others used during the trial says nothing about the chosen number.
        self._others()

    def _try_next(self, now_s: float) -> None:
        self._use(self._waiting[0])
        self._n_steps, self._began_s = 0, now_s

    @staticmethod
    def _use(number: int) -> None:
        if torch.get_num_threads() != number:
            torch.set_num_threads(number)
