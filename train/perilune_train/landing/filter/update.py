"""Measurement update of the state, and the gate on the normalised innovation squared."""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dtrsm
from scipy.stats import chi2

from perilune_shared.geometry.frames import Array
from perilune_train.landing.filter.state import State

GATE_SHARE = 0.001
"""Probability that the gate rejects a correct measurement."""


def passes_gate(difference: Array, covariance: Array) -> bool:
    """Whether a difference (n,) is consistent with its covariance (n, n)."""
    return float(difference @ np.linalg.solve(covariance, difference)) <= gate(len(difference))


@cache
def gate(n_parts: int) -> float:
    """Largest accepted normalised innovation squared for a measurement of `n_parts` numbers."""
    return float(chi2.isf(GATE_SHARE, n_parts))


def updated(state: State, innovation: Array, crossed: Array, spread: Array) -> State:
    """The state after a measurement, without a gate.

    `innovation` (n,) is the measurement minus its prediction. `crossed` (n, N) is the covariance of the innovation with
    the error state, and `spread` (n, n) is the covariance of the innovation, including measurement noise.
    """
    root = np.linalg.cholesky(spread)
    # Scale the innovation so that its elements are independent with standard deviation 1. Transposes need no copies.
    innovation = solve_triangular(root, innovation, lower=True, check_finite=False)
    crossed = dtrsm(1.0, root.T, crossed.T, side=1).T
    covariance = crossed.T @ crossed
    np.subtract(state.covariance, covariance, out=covariance)
    after = state.corrected(innovation @ crossed, covariance)
    return replace(after, innovation_squared=float(innovation @ innovation), n_innovations=len(innovation))
