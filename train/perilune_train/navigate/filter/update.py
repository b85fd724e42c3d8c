"""Updates of the state by measurements, with a gate on the normalised innovation squared."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.stats import chi2

from perilune_shared.geometry.frames import Array
from perilune_train.navigate.filter.state import State

GATE_SHARE = 0.001
"""Share of right measurements that the gate refuses."""


@dataclass(frozen=True, slots=True)
class Update:
    """What a measurement did."""

    state: State
    """The state after it; the same if it was refused."""
    innovation_squared: float
    """Normalised innovation squared: as many as it has parts, in the mean."""
    n_parts: int
    """Number of parts of the measurement."""
    accepted: bool
    """Whether it passed the gate."""


def passes_gate(difference: Array, covariance: Array) -> bool:
    """Whether a difference (n,) is likely enough for its covariance (n, n)."""
    return float(difference @ np.linalg.solve(covariance, difference)) <= _gate(len(difference))


@cache
def _gate(n_parts: int) -> float:
    """Largest normalised innovation squared of a measurement of so many parts."""
    return float(chi2.isf(GATE_SHARE, n_parts))


def updated(state: State, innovation: Array, by_error: Array, noise: Array, gate: bool = True) -> Update:
    """Update by a measurement: innovation (n,), its derivative by the first parts of the error state (n, m), noise
    covariance (n, n)."""
    m = by_error.shape[1]
    crossed = state.covariance[:, :m] @ by_error.T
    spread = by_error @ crossed[:m] + noise
    squared = float(innovation @ np.linalg.solve(spread, innovation))
    if gate and squared > _gate(len(innovation)):
        return Update(state, squared, len(innovation), False)
    gain = np.linalg.solve(spread, crossed.T).T
    covariance = state.covariance - gain @ crossed.T
    return Update(state.corrected(gain @ innovation, covariance), squared, len(innovation), True)
