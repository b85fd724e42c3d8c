"""Order and augmentation of the sequences of every epoch of navigation training."""

import numpy as np
from torch.utils import data as torch_data

from perilune_train.data.shares import Share
from perilune_train.motion.data.sequences import Jitter, Sequence, pair_sequence
from perilune_train.motion.data.trajectories import Trajectory

Key = tuple[int, int, int, int]
"""Epoch, position in the epoch's order, number of the trajectory, and first pair of the sequence."""


class TrainingSequences(torch_data.Dataset):
    """The training sequences of one process; they depend only on trajectories, seed and epoch.

    A trajectory gives about as many sequences of `n_pairs` pairs as fit into it. Each sequence has a random start.
    `n_pairs` is reduced to the length of the shortest trajectory. A sequence belongs to the process that has its
    trajectory. Sequences for `warp` are mirrored and, with `jitter`, moved (see `pair_sequence`).
    """

    def __init__(
        self,
        trajectories: list[Trajectory],
        n_pairs: int,
        *,
        warp: bool,
        jitter: Jitter | None,
        seed: int,
        share: Share,
    ):
        self.trajectories, self.warp = trajectories, warp
        self.jitter, self.seed, self.share = jitter, seed, share
        self.n_pairs = min(n_pairs, *(trajectory.n_pairs for trajectory in trajectories))
        self.counts = [round(trajectory.n_pairs / self.n_pairs) for trajectory in trajectories]

    @property
    def fewest(self) -> int:
        """Smallest number of sequences of any process."""
        processes = self.share.processes
        return min(sum(self.counts[process::processes]) for process in range(processes))

    def keys(self, epoch: int) -> list[Key]:
        """Keys of this process's sequences in the order of an epoch."""
        rng = np.random.default_rng([self.seed, epoch])
        windows = [
            (number, int(start))
            for number, (trajectory, count) in enumerate(zip(self.trajectories, self.counts, strict=True))
            for start in rng.integers(0, trajectory.n_pairs - self.n_pairs + 1, count)
        ]
        rng.shuffle(windows)
        numbers = set(self.share.of(len(self.trajectories)))
        return [(epoch, position, *sequence) for position, sequence in enumerate(windows) if sequence[0] in numbers]

    def __getitem__(self, key: Key) -> Sequence:
        _, _, number, start = key
        return self.augmented_sequence(key, self.trajectories[number], start)

    def augmented_sequence(self, key: Key, trajectory: Trajectory, start: int) -> Sequence:
        """The pairs of a trajectory from `start` on, with the augmentation that belongs to the key."""
        epoch, position, _, _ = key
        rng = np.random.default_rng([self.seed, epoch, position]) if self.warp else None
        return pair_sequence(trajectory, start, self.n_pairs, warp=self.warp, rng=rng, jitter=self.jitter)
