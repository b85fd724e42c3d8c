"""Divide the data among several processes that train together."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Share:
    """The share of one of n processes: every n-th frame or trajectory, the same ones in every epoch."""

    process: int = 0
    """Rank of the process, from 0."""
    processes: int = 1
    """Number of processes that train together."""

    def of(self, count: int) -> range:
        """The numbers among 0 .. count - 1 that belong to this share."""
        return range(self.process, count, self.processes)

    def owns(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """For each of the numbers (N,), whether it belongs to this share (N,)."""
        return numbers % self.processes == self.process


ALONE = Share()
"""The share of a single process: everything."""
