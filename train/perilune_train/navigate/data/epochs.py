"""Batches of one epoch of navigation training."""

from collections.abc import Iterator

import numpy as np

from perilune_train.navigate.data.sequences import Jitter, Sequence, pair_sequence
from perilune_train.navigate.data.trajectories import Trajectory


class EpochBatches:
    """One epoch of batches of sequences; depends on trajectories and key (seed, epoch) only.

    A trajectory gives about as many sequences of `n_pairs` (at most the length of the shortest trajectory) as fit into
    it, each with its own random start. Iterates over lists of `batch` sequences; `augmented` sequences are mirrored
    and, with `jitter`, moved (see `pair_sequence`).
    """

    def __init__(
        self,
        trajectories: list[Trajectory],
        n_pairs: int,
        batch: int,
        *,
        warp: bool,
        augmented: bool,
        jitter: Jitter | None,
        key: tuple[int, ...],
    ):
        self.trajectories, self.batch, self.warp, self.augmented = trajectories, batch, warp, augmented
        self.jitter, self.key = jitter, key
        self.n_pairs = min(n_pairs, *(trajectory.n_pairs for trajectory in trajectories))
        rng = np.random.default_rng(key)
        self.places = [
            (number, int(start))
            for number, trajectory in enumerate(trajectories)
            for start in rng.integers(
                0, trajectory.n_pairs - self.n_pairs + 1, round(trajectory.n_pairs / self.n_pairs)
            )
        ]
        rng.shuffle(self.places)

    def __len__(self) -> int:
        return -(-len(self.places) // self.batch)

    def __iter__(self) -> Iterator[list[Sequence]]:
        for begin in range(0, len(self.places), self.batch):
            yield [self._sequence(i) for i in range(begin, min(begin + self.batch, len(self.places)))]

    def _sequence(self, i: int) -> Sequence:
        number, start = self.places[i]
        rng = np.random.default_rng([*self.key, i]) if self.augmented else None
        return pair_sequence(
            self.trajectories[number], start, self.n_pairs, warp=self.warp, rng=rng, jitter=self.jitter
        )
