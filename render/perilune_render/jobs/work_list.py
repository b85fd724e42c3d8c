"""Choose which trajectory of a job a process renders next, and count failed attempts."""

from collections import Counter, deque
from collections.abc import Iterable

from perilune_render.flight.plan import Plan

N_ATTEMPTS = 4
"""Number of attempts for each trajectory, including the first."""


class WorkList:
    """The trajectories that are still to be rendered, by their index in the plan.

    They are handed out so that a process rarely changes its scene.
    """

    def __init__(self, plan: Plan, indices: Iterable[int]):
        self._scene = [trajectory.scene_id for trajectory in plan.trajectories]
        self._waiting: dict[str, deque[int]] = {}
        for index in indices:
            self._waiting.setdefault(self._scene[index], deque()).append(index)
        self._untouched = deque(self._waiting)
        self._running: Counter[str] = Counter()
        self._attempts: Counter[int] = Counter()
        self.failures: dict[int, str] = {}
        """Error of the last attempt of each trajectory that failed N_ATTEMPTS times."""

    @property
    def n_waiting(self) -> int:
        """Number of trajectories that wait for a process, for a first or a further attempt."""
        return sum(map(len, self._waiting.values()))

    def take(self, scene_id: str | None) -> int | None:
        """The next trajectory for a process that holds the scene `scene_id`; None if no trajectory is waiting.

        The first choice is a trajectory of this scene, the second a trajectory of a scene that no process has begun,
        the third a trajectory of the scene that the fewest processes are rendering.
        """
        if scene_id not in self._waiting:
            while self._untouched and self._untouched[0] not in self._waiting:
                self._untouched.popleft()
            if not self._waiting:
                return None
            fewest = min(self._waiting, key=self._running.__getitem__) if not self._untouched else None
            scene_id = fewest or self._untouched.popleft()
        elif self._untouched and self._untouched[0] == scene_id:
            self._untouched.popleft()
        indices = self._waiting[scene_id]
        index = indices.popleft()
        if not indices:
            del self._waiting[scene_id]
        self._running[scene_id] += 1
        self._attempts[index] += 1
        return index

    def done(self, index: int) -> None:
        """Record that a trajectory is finished."""
        self._running[self._scene[index]] -= 1

    def failed(self, index: int, error: str) -> int:
        """Record a failed attempt; return the number of attempts left.

        The trajectory waits again if attempts are left.
        """
        self._running[self._scene[index]] -= 1
        left = N_ATTEMPTS - self._attempts[index]
        if left > 0:
            self._waiting.setdefault(self._scene[index], deque()).append(index)
        else:
            self.failures[index] = error
        return left
