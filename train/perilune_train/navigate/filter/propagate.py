"""Propagation of the state by inertial measurements (strapdown integration, e.g. Sola 2017, arXiv 1711.02508)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import HOUR_S, STANDARD_GRAVITY_MPS2, InertialErrors
from perilune_train.navigate.filter.state import (
    ATTITUDE,
    FORCE_BIAS,
    GROUND,
    GYRO_BIAS,
    POSITION,
    VELOCITY,
    State,
)

_GROUND_S = 10.0
"""Time in which the ground below a lander becomes another, at 10 to 30 m/s over ground."""
_CHANGED = 15
"""Parts of the error state that change between measurements: all but the last frame's pose and the offsets."""


@dataclass(frozen=True, slots=True)
class Increment:
    """One measurement of an inertial unit: means over an interval."""

    time_s: float
    """End of the interval, seconds since the first frame."""
    interval_s: float
    """Length of the interval, seconds."""
    angular_rate_radps: Array
    """Mean angular rate (3,), O_B."""
    specific_force_mps2: Array
    """Mean specific force (3,), O_B."""

    @property
    def is_finite(self) -> bool:
        """Whether all of it was measured."""
        return bool(np.isfinite(self.angular_rate_radps).all() and np.isfinite(self.specific_force_mps2).all())


def start_sigmas(position_m: float, velocity_mps: float, attitude_deg: float, unit: InertialErrors) -> Array:
    """Standard deviations (15,) of the first errors of `State` at the start, from those on each axis."""
    gyro_bias_radps = np.radians(unit.gyro_bias_deg_per_h) / HOUR_S
    force_bias_mps2 = unit.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000
    return np.repeat([position_m, velocity_mps, np.radians(attitude_deg), gyro_bias_radps, force_bias_mps2], 3)


@dataclass(frozen=True, slots=True)
class InertialNoise:
    """Variances that a unit adds in one second, per axis."""

    turn: float
    """Of the attitude, square radians."""
    velocity: float
    """Of the velocity, square metres per square second."""
    gyro_bias: float
    """Of the gyroscope's bias."""
    force_bias: float
    """Of the accelerometer's bias."""

    @classmethod
    def of(cls, errors: InertialErrors) -> "InertialNoise":
        """From the errors of a grade."""
        per_s, milli_g = np.radians(1) / HOUR_S, STANDARD_GRAVITY_MPS2 / 1000
        return cls(
            np.radians(errors.angular_random_walk_deg) ** 2 / HOUR_S,
            errors.velocity_random_walk_mps**2 / HOUR_S,
            (errors.gyro_bias_walk_deg_per_h * per_s) ** 2 / HOUR_S,
            (errors.accelerometer_bias_walk_mg * milli_g) ** 2 / HOUR_S,
        )


def propagated(state: State, measured: Sequence[Increment], noise: InertialNoise, relief_m: float) -> State:
    """The state after consecutive inertial measurements, each over its interval.

    The ground's height below changes as a Gauss-Markov process of deviation `relief_m`.
    """
    position, velocity, rotation = state.position_m, state.velocity_mps, state.rotation_site_from_body
    added = np.repeat([0.0, noise.velocity, noise.turn, noise.gyro_bias, noise.force_bias], 3)
    change, variance = np.eye(_CHANGED), np.zeros((_CHANGED, _CHANGED))
    for one in measured:
        step = one.interval_s
        rate = one.angular_rate_radps - state.gyro_bias_radps
        force = one.specific_force_mps2 - state.force_bias_mps2
        half = matrix_from_rotation_vector(rate * (step / 2))
        middle = rotation @ half
        acceleration = middle @ force + gravity_mps2(position[2])
        own = _change(middle, half @ half, force, step)
        change, variance = own @ change, own @ variance @ own.T
        variance[np.diag_indices(_CHANGED)] += added * step
        position = position + velocity * step + acceleration * (step**2 / 2)
        velocity = velocity + acceleration * step
        rotation = middle @ half
    covariance, kept = state.covariance.copy(), np.exp(-sum(one.interval_s for one in measured) / _GROUND_S)
    covariance[GROUND] *= kept
    covariance[:, GROUND] *= kept
    covariance[GROUND, GROUND] += relief_m**2 * (1 - kept**2)
    own = change @ covariance[:_CHANGED]
    covariance[:_CHANGED], covariance[:, :_CHANGED] = own, own.T
    covariance[:_CHANGED, :_CHANGED] = own[:, :_CHANGED] @ change.T + variance
    return replace(
        state,
        time_s=measured[-1].time_s,
        position_m=position,
        velocity_mps=velocity,
        rotation_site_from_body=rotation,
        ground_m=float(kept * state.ground_m),
        covariance=covariance,
    )


def _change(middle: Array, turn: Array, force: Array, step: float) -> Array:
    """Derivative (15, 15) of the errors after a step by those before: that of the attitude turns the force, and those
    of the biases add up."""
    x, y, z = force
    by_turn = middle @ np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    change = np.eye(_CHANGED)
    change[[0, 1, 2], [3, 4, 5]], change[[6, 7, 8], [9, 10, 11]] = step, -step
    change[POSITION, ATTITUDE], change[VELOCITY, ATTITUDE] = by_turn * (step**2 / 2), by_turn * step
    change[POSITION, GYRO_BIAS], change[VELOCITY, GYRO_BIAS] = by_turn * (-(step**3) / 4), by_turn * (-(step**2) / 2)
    change[POSITION, FORCE_BIAS], change[VELOCITY, FORCE_BIAS] = middle * (-(step**2) / 2), middle * -step
    change[ATTITUDE, ATTITUDE] = turn.T
    return change
