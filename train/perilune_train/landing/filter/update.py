"""Updates of the state by measurements, with a gate on the normalised innovation squared."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dtrsm
from scipy.stats import chi2

from perilune_shared.geometry.frames import Array
from perilune_train.landing.filter.state import State

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
    return float(difference @ np.linalg.solve(covariance, difference)) <= gate(len(difference))


@cache
def gate(n_parts: int) -> float:
    """Largest normalised innovation squared of a measurement of so many parts."""
    return float(chi2.isf(GATE_SHARE, n_parts))


def updated(state: State, innovation: Array, by_error: Array, noise: Array) -> Update:
    """Update by a measurement: innovation (n,), its derivative by the first parts of the error state (n, m), noise
    covariance (n, n)."""
    m = by_error.shape[1]
    crossed = by_error @ state.covariance[:m]
    return updated_by(state, innovation, crossed, crossed[:, :m] @ by_error.T + noise)


def updated_by(state: State, innovation: Array, crossed: Array, spread: Array, gated: bool = True) -> Update:
    """Update by a measurement: innovation (n,), its covariance with the error state (n, N), its own (n, n)."""
    root = np.linalg.cholesky(spread)
    # In units in which the parts of the innovation are independent and of deviation 1. The transposes need no copies.
    innovation = solve_triangular(root, innovation, lower=True, check_finite=False)
    crossed = dtrsm(1.0, root.T, crossed.T, side=1).T
    squared = float(innovation @ innovation)
    if gated and squared > gate(len(innovation)):
        return Update(state, squared, len(innovation), False)
    covariance = crossed.T @ crossed
    np.subtract(state.covariance, covariance, out=covariance)
    return Update(state.corrected(innovation @ crossed, covariance), squared, len(innovation), True)
