"""Batches of sequences of one epoch of navigation training, drawn from a key."""

from collections.abc import Iterator

import numpy as np

from perilune_train.navigate.data import Descent, Jitter, Sequence, pair_sequence


class EpochBatches:
    """One epoch of batches of sequences, each pair about once, drawn from the key (seed, epoch) only.

    Each trajectory is cut into runs of `n_pairs` (at most the length of the shortest trajectory) that begin at a random
    offset. Iterates over lists of `batch` sequences; `augmented` sequences are mirrored and, with `jitter`, moved (see
    `pair_sequence`).
    """

    def __init__(
        self,
        descents: list[Descent],
        n_pairs: int,
        batch: int,
        *,
        warp: bool,
        augmented: bool,
        jitter: Jitter | None,
        key: tuple[int, ...],
    ):
        self.descents, self.batch, self.warp, self.augmented = descents, batch, warp, augmented
        self.jitter, self.key = jitter, key
        self.n_pairs = min(n_pairs, *(descent.n_pairs for descent in descents))
        rng = np.random.default_rng(key)
        self.places = [
            (number, int(start))
            for number, descent in enumerate(descents)
            for start in rng.integers(0, descent.n_pairs - self.n_pairs + 1, round(descent.n_pairs / self.n_pairs))
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
        return pair_sequence(self.descents[number], start, self.n_pairs, warp=self.warp, rng=rng, jitter=self.jitter)
