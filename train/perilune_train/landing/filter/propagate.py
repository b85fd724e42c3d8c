"""Propagate the state by inertial measurements (strapdown integration; Sola 2017, arXiv 1711.02508)."""

from dataclasses import dataclass, replace

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import HOUR_S, STANDARD_GRAVITY_MPS2, InertialErrors
from perilune_train.landing.filter.state import (
    ATTITUDE,
    FORCE_BIAS,
    POSITION,
    VELOCITY,
    cross_matrices,
    rotation_matrices,
)

_INERTIAL = 15
"""Number of elements at the start of the error state that inertial measurements change."""


@dataclass(frozen=True, slots=True)
class Increments:
    """N inertial measurements in time order, means over intervals, for one flight or for F flights."""

    time_s: Array
    """Ends of the intervals (N,), seconds since the first frame."""
    interval_s: Array
    """Lengths of the intervals (N,), seconds."""
    angular_rate_radps: Array
    """Mean angular rates (N, 3) or (F, N, 3), O_B; NaN where they are missing."""
    specific_force_mps2: Array
    """Mean specific forces, shaped like the rates, O_B."""

    @classmethod
    def single(cls, time_s: float, interval_s: float, rate_radps: Array, force_mps2: Array) -> "Increments":
        """One measurement: end and length of its interval, rate (3,) and force (3,)."""
        return cls(np.array([time_s]), np.array([interval_s]), np.array([rate_radps]), np.array([force_mps2]))

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, chosen: slice | Array) -> "Increments":
        """The chosen measurements only."""
        rate, force = self.angular_rate_radps[..., chosen, :], self.specific_force_mps2[..., chosen, :]
        return Increments(self.time_s[chosen], self.interval_s[chosen], rate, force)

    def measured(self) -> "Increments":
        """The measurements that are finite in all flights."""
        finite = np.isfinite(self.angular_rate_radps) & np.isfinite(self.specific_force_mps2)
        finite = finite.all(axis=(*range(finite.ndim - 2), -1))
        return self if finite.all() else self.part(finite)

    def until(self, time_s: float) -> "Increments":
        """Cut a single measurement at a time within its interval."""
        interval_s = np.maximum(time_s - (self.time_s - self.interval_s), 0.0)
        return Increments(np.array([time_s]), interval_s, self.angular_rate_radps, self.specific_force_mps2)


def start_sigmas(position_m: float, velocity_mps: float, attitude_deg: float, unit: InertialErrors) -> Array:
    """Initial standard deviations (15,) of the first 15 elements of the error state."""
    gyro_bias_radps = np.radians(unit.gyro_bias_deg_per_h) / HOUR_S
    force_bias_mps2 = unit.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000
    return np.repeat([position_m, velocity_mps, np.radians(attitude_deg), gyro_bias_radps, force_bias_mps2], 3)


COAST_MPS2, COAST_DEGPS = 2.0, 3.0
"""Default standard deviations of the acceleration (metres per second^2) and the angular rate (degrees per second) while
inertial measurements are missing."""


@dataclass(frozen=True, slots=True)
class InertialNoise:
    """Variances that an inertial unit adds per second and axis, and noise while measurements are missing."""

    turn: float
    """Variance of the attitude, square radians."""
    velocity: float
    """Variance of the velocity, square metres per square second."""
    gyro_bias: float
    """Variance of the gyroscope's bias, square radians per square second."""
    force_bias: float
    """Variance of the accelerometer's bias, square metres per second^4."""
    coast_mps2: float = COAST_MPS2
    """Standard deviation of the acceleration while measurements are missing, metres per second^2."""
    coast_radps: float = float(np.radians(COAST_DEGPS))
    """Standard deviation of the angular rate while measurements are missing, radians per second."""

    @classmethod
    def of(cls, errors: InertialErrors) -> "InertialNoise":
        """The noise of an inertial unit with the errors of a grade."""
        per_s, milli_g = np.radians(1) / HOUR_S, STANDARD_GRAVITY_MPS2 / 1000
        return cls(
            np.radians(errors.angular_random_walk_deg) ** 2 / HOUR_S,
            errors.velocity_random_walk_mps**2 / HOUR_S,
            (errors.gyro_bias_walk_deg_per_h * per_s) ** 2 / HOUR_S,
            (errors.accelerometer_bias_walk_mg * milli_g) ** 2 / HOUR_S,
        )


@dataclass(frozen=True, slots=True)
class Moving:
    """The parts of the states of F flights that change with time."""

    position_m: Array
    """Positions (F, 3), O_L."""
    velocity_mps: Array
    """Velocities (F, 3), O_L."""
    rotation_site_from_body: Array
    """Attitudes (F, 3, 3)."""
    gyro_bias_radps: Array
    """Biases of the gyroscopes (F, 3), O_B."""
    force_bias_mps2: Array
    """Biases of the accelerometers (F, 3), O_B."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Motions of F flights over a time span, and their effect on the first 15 elements of the error state."""

    end: Moving
    """The state at the end of the span."""
    change: Array
    """Derivative (F, 15, 15) of the errors at the end with respect to the errors at the start."""
    added: Array
    """Covariance (F, 15, 15) that the noise of the inertial unit adds."""


def integrated(start: Moving, measured: Increments, noise: InertialNoise) -> Motion:
    """Integrate consecutive inertial measurements, each over its interval."""
    position, velocity, rotation_site_from_body = start.position_m, start.velocity_mps, start.rotation_site_from_body
    n, step_s = len(measured), measured.interval_s
    # Time is the first axis, because the loop below takes one step at a time.
    rate = np.moveaxis(measured.angular_rate_radps - start.gyro_bias_radps[:, None], 1, 0)
    force = np.moveaxis(measured.specific_force_mps2 - start.force_bias_mps2[:, None], 1, 0)
    half = rotation_matrices(rate * (step_s / 2)[:, None, None])
    middle = np.empty_like(half)
    for k in range(n):
        middle[k] = rotation_site_from_body @ half[k]
        rotation_site_from_body = middle[k] @ half[k]
        acceleration = (middle[k] @ force[k][..., None])[..., 0] + gravity_mps2(position[:, 2])
        position = position + velocity * step_s[k] + acceleration * (step_s[k] ** 2 / 2)
        velocity = velocity + acceleration * step_s[k]
    changes = _changes(middle, half, force, step_s)
    # The noise of a step is propagated by all later steps, so multiply from the last step to the first.
    onward = np.empty((len(position), _INERTIAL, n, _INERTIAL))
    change = np.eye(_INERTIAL)
    for k in reversed(range(n)):
        onward[:, :, k] = change
        change = change @ changes[k]
    per_s = np.repeat([0.0, noise.velocity, noise.turn, noise.gyro_bias, noise.force_bias], 3)
    onward = (onward * np.sqrt(per_s * step_s[:, None])).reshape(len(position), _INERTIAL, -1)
    end = replace(start, position_m=position, velocity_mps=velocity, rotation_site_from_body=rotation_site_from_body)
    return Motion(end, change, onward @ np.swapaxes(onward, 1, 2))


def _changes(middle: Array, half: Array, force: Array, step_s: Array) -> Array:
    """Derivatives (N, F, 15, 15) of the errors after a step with respect to the errors before the step.

    An attitude error rotates the measured force; bias errors are integrated over the step. `middle` (N, F, 3, 3) holds
    the attitudes at the middle of the steps, and `half` (N, F, 3, 3) the rotations from the start to the middle of each
    step.
    """
    step = step_s[:, None, None, None]
    by_turn = -middle @ cross_matrices(force)
    change = np.zeros((*force.shape[:2], _INERTIAL, _INERTIAL))
    change[:] = np.eye(_INERTIAL)
    change[..., [0, 1, 2], [3, 4, 5]], change[..., [6, 7, 8], [9, 10, 11]] = step[..., 0], -step[..., 0]
    by_velocity = np.concatenate([by_turn * step, by_turn * (-(step**2) / 2), middle * -step], axis=-1)
    change[..., VELOCITY, ATTITUDE.start : FORCE_BIAS.stop] = by_velocity
    change[..., POSITION, ATTITUDE.start : FORCE_BIAS.stop] = by_velocity * (step / 2)
    turn = half @ half
    change[..., ATTITUDE, ATTITUDE] = np.swapaxes(turn, -1, -2)
    return change
