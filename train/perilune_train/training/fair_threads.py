"""Adapt torch's number of CPU threads to the load from other processes on the machine."""

import math
import time
from collections.abc import Callable

import torch

from perilune_shared.threads import OtherWork, chosen_by_user

_CHECK_S = 1.0
"""Interval at which the load of other processes is read, seconds."""
_TRIAL_S, _TRIAL_STEPS = 1.0, 3
"""Smallest duration, seconds, and smallest number of steps of a trial with one number of threads."""
_RETRY_S = 20.0
"""Smallest interval between two trials, seconds."""
_QUIET_CORES = 0.2
"""Load of other processes, in cores, below which all threads are used."""
_GAIN = 1.03
"""Smallest ratio of new to old speed at which the number of threads changes."""


class FairThreads:
    """Chooses torch's number of CPU threads for each step of a loop, and restores the program's number afterwards.

    An operation ends when its slowest thread ends. If another process takes half of one core, all threads of an
    operation effectively run at half speed, and fewer threads are faster. While other processes use the cores, trials
    of a few steps with fewer threads decide on the number. When the other processes have ended, all threads are used
    again.

    The number of threads changes the last digits of sums, so two trainings on a busy machine are equal only up to
    rounding. The number stays constant on an idle machine, on a GPU, and if OMP_NUM_THREADS is set. For exactly
    repeatable trainings, set OMP_NUM_THREADS.

    Example:

        threads = FairThreads()
        for batch in batches:
            with threads:
                train_on(batch)
    """

    def __init__(
        self,
        enabled: bool = True,
        clock: Callable[[], float] = time.monotonic,
        others: Callable[[], float] | None = None,
    ):
        """Without `enabled` the number of threads stays constant.

        Disable it if torch computes on a GPU, or if several training processes share the cores. `clock` returns the
        time, s. `others` returns the number of cores that other processes have used since the last call of `others`.
        """
        self._active = enabled and not chosen_by_user("OMP_NUM_THREADS")
        self._clock, self._others = clock, OtherWork().cores if others is None else others
        self._checked_s, self._tried_s = clock(), clock() - _RETRY_S
        self._most = self._number = self._preferred = torch.get_num_threads()
        """Numbers of threads: set by the program, used in the next step, and used outside trials."""
        self._waiting: list[int] = []
        """Numbers of threads that are still to be tried, the current one first; empty outside trials."""
        self._speeds: dict[int, float] = {}
        self._n_steps, self._steps_s, self._began_s = 0, 0.0, 0.0

    def __enter__(self) -> "FairThreads":
        if self._active:
            if torch.get_num_threads() != self._most:
                # The program has set another number since the last step.
                self._most = self._number = self._preferred = torch.get_num_threads()
                self._waiting = []
            _use(self._number)
            self._began_s = self._clock()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._active:
            return
        self.restore()
        now_s = self._clock()
        if self._waiting:
            self._measure(now_s)
        elif self._most > 1 and now_s - self._checked_s >= _CHECK_S:
            self._check(now_s)

    def restore(self) -> None:
        """Restore the program's number of threads after a failed step."""
        if self._active:
            _use(self._most)

    def _check(self, now_s: float) -> None:
        self._checked_s, others = now_s, self._others()
        if others < _QUIET_CORES:
            self._number = self._preferred = self._most
        elif now_s - self._tried_s >= _RETRY_S:
            fewer = max(1, self._most - math.ceil(others - _QUIET_CORES))
            self._waiting, self._speeds = list(dict.fromkeys([self._preferred, self._most, fewer])), {}
            self._try_next()

    def _measure(self, now_s: float) -> None:
        self._n_steps, self._steps_s = self._n_steps + 1, self._steps_s + now_s - self._began_s
        if self._n_steps < _TRIAL_STEPS or self._steps_s < _TRIAL_S:
            return
        self._speeds[self._waiting.pop(0)] = self._n_steps / self._steps_s
        if self._waiting:
            self._try_next()
            return
        best = max(self._speeds, key=lambda number: self._speeds[number])
        if self._speeds[best] > _GAIN * self._speeds[self._preferred]:
            self._preferred = best
        self._number = self._preferred
        self._checked_s = self._tried_s = now_s
        # Discard the load measured during the trial, because it does not apply to the chosen number.
        self._others()

    def _try_next(self) -> None:
        self._number, self._n_steps, self._steps_s = self._waiting[0], 0, 0.0


def _use(number: int) -> None:
    if torch.get_num_threads() != number:
        torch.set_num_threads(number)
