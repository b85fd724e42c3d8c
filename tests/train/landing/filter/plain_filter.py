"""The filter as in the books: every measurement changes the whole state and its whole covariance at once.

What the fast filter must equal. One flight, one measurement after the other.
"""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_train.landing.filter.state import N_ERRORS
from perilune_train.landing.filter.update import GATE_SHARE

GROUND_S = 10.0


def propagated(state, end_s, rate, force, noise, relief_m):
    """The state after one inertial measurement from its time on."""
    step = end_s - state.time_s
    rate, force = rate - state.gyro_bias_radps, force - state.force_bias_mps2
    half = matrix_from_rotation_vector(rate * step / 2)
    middle = state.rotation_site_from_body @ half
    acceleration = middle @ force + gravity_mps2(state.position_m[2])
    x, y, z = force
    by_turn = middle @ np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    n, one = len(state.covariance), np.eye(3)
    change, added = np.eye(n), np.zeros(n)
    change[:3, 3:6], change[:3, 6:9] = step * one, by_turn * step**2 / 2
    change[:3, 9:12], change[:3, 12:15] = -by_turn * step**3 / 4, -middle * step**2 / 2
    change[3:6, 6:9], change[3:6, 9:12], change[3:6, 12:15] = by_turn * step, -by_turn * step**2 / 2, -middle * step
    change[6:9, 6:9], change[6:9, 9:12] = (half @ half).T, -step * one
    kept = np.exp(-step / GROUND_S)
    change[20, 20], added[20] = kept, relief_m**2 * (1 - kept**2)
    added[:15] = step * np.repeat([0, noise.velocity, noise.turn, noise.gyro_bias, noise.force_bias], 3)
    return replace(
        state,
        time_s=end_s,
        position_m=state.position_m + state.velocity_mps * step + acceleration * step**2 / 2,
        velocity_mps=state.velocity_mps + acceleration * step,
        rotation_site_from_body=middle @ half,
        ground_m=float(kept * state.ground_m),
        angular_rate_radps=rate,
        covariance=change @ state.covariance @ change.T + np.diag(added),
    )


def coasted(state, end_s):
    """The state after a time without inertial measurements."""
    gap, change = end_s - state.time_s, np.eye(len(state.covariance))
    change[:3, 3:6] = gap * np.eye(3)
    covariance = change @ state.covariance @ change.T
    covariance[range(9), range(9)] += np.repeat([gap**2, 2 * gap, np.radians(3) * gap], 3) ** 2
    return replace(state, time_s=end_s, position_m=state.position_m + gap * state.velocity_mps, covariance=covariance)


def updated(state, innovation, by_error, noise, gated=True):
    """The state after a measurement; unchanged if the gate refuses it."""
    whole = np.zeros((len(innovation), len(state.covariance)))
    whole[:, : by_error.shape[1]] = by_error
    spread = whole @ state.covariance @ whole.T + noise
    if gated and innovation @ np.linalg.inv(spread) @ innovation > chi2.isf(GATE_SHARE, len(innovation)):
        return state
    gain = state.covariance @ whole.T @ np.linalg.inv(spread)
    return state.corrected(gain @ innovation, state.covariance - gain @ spread @ gain.T)


def numeric(state, expected_of, n):
    """The derivative (n, 25) of an expected measurement by the error state, by central differences."""
    by_error, step = np.zeros((n, N_ERRORS)), 1e-6
    for k in range(N_ERRORS):
        error = np.zeros(len(state.covariance))
        error[k] = step
        above, below = (expected_of(state.corrected(sign * error, state.covariance)) for sign in (1, -1))
        by_error[:, k] = (above - below) / (2 * step)
    return by_error


def along(state, range_m, ground_m, sigma_m, beam):
    """The state after a range along a beam, with a numeric derivative."""

    def expected_of(state):
        height_m = state.position_m[2] - ground_m - state.ground_m
        return np.array([height_m / -(state.rotation_site_from_body @ beam)[2]])

    by_error = numeric(state, expected_of, 1)
    return updated(state, range_m - expected_of(state), by_error, np.array([[sigma_m**2]]))


def sped(state, speed_mps, sigma_mps, beam):
    """The state after a speed along a beam, with a numeric derivative."""

    def expected_of(state):
        return np.array([state.velocity_mps @ state.rotation_site_from_body @ beam])

    by_error = numeric(state, expected_of, 1)
    return updated(state, speed_mps - expected_of(state), by_error, np.array([[sigma_mps**2]]))


def turned(state, rotation_site_from_body, sigmas_rad):
    """The state after an attitude."""
    innovation = rotation_vectors(state.rotation_site_from_body.T @ rotation_site_from_body)
    by_error = np.zeros((3, N_ERRORS))
    by_error[:, 6:9] = np.eye(3)
    return updated(state, innovation, by_error, np.diag(np.square(sigmas_rad)))


def ranged(state, range_m, ground_m, sigma_m):
    """The state after a range."""
    rotation, height_m = state.rotation_site_from_body, state.position_m[2] - ground_m - state.ground_m
    cosine, by_error = rotation[2, 2], np.zeros((1, N_ERRORS))
    by_error[0, 2], by_error[0, 20] = 1 / cosine, -1 / cosine
    by_error[0, 6:8] = height_m / cosine**2 * np.array([rotation[2, 1], -rotation[2, 0]])
    return updated(state, np.array([range_m - height_m / cosine]), by_error, np.array([[sigma_m**2]]))
