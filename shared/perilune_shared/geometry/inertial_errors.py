"""Random errors of inertial measurement units."""

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import HOUR_S, STANDARD_GRAVITY_MPS2, InertialErrors


def drawn_errors(errors: InertialErrors, interval_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw errors (N, 3) of mean angular rates, rad/s, and (N, 3) of mean specific forces, m/s^2.

    Each rate and force is the mean over one of the N intervals.
    """
    per_s, per_root_s = np.radians(1) / HOUR_S, 1 / np.sqrt(HOUR_S)
    mg = STANDARD_GRAVITY_MPS2 / 1000
    gyro = _drawn(
        rng,
        interval_s,
        errors.gyro_bias_deg_per_h * per_s,
        errors.gyro_bias_walk_deg_per_h * per_s * per_root_s,
        np.radians(errors.angular_random_walk_deg) * per_root_s,
    )
    accelerometer = _drawn(
        rng,
        interval_s,
        errors.accelerometer_bias_mg * mg,
        errors.accelerometer_bias_walk_mg * mg * per_root_s,
        errors.velocity_random_walk_mps * per_root_s,
    )
    return gyro, accelerometer


def drawn_axes(errors: InertialErrors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw the matrices (3, 3) from true to measured angular rates and specific forces, O_B.

    The diagonals hold the scale factors, and the other elements the misalignments.
    """
    scale, turn = errors.scale_ppm * 1e-6, np.radians(errors.misalignment_arcsec / 3600)
    sigmas = np.where(np.eye(3, dtype=bool), scale, turn)
    gyro, accelerometer = np.eye(3) + sigmas * rng.normal(size=(2, 3, 3))
    return gyro, accelerometer


def _drawn(rng: np.random.Generator, interval_s: Array, bias: float, walk: float, noise: float) -> Array:
    """Draw errors (N, 3) from the standard deviations of the bias, its random walk and the white noise.

    `walk`, and `noise` of the integrated quantity, are per square root of a second.
    """
    size = len(interval_s), 3
    root = np.sqrt(interval_s)[:, None]
    start = bias * rng.normal(size=3)
    steps = walk * root * rng.normal(size=size)
    return start + np.cumsum(steps, axis=0) + noise / root * rng.normal(size=size)
