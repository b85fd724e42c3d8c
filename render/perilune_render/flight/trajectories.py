"""Perturbed descents: a nominal parabola plus smooth Gaussian departures in position and attitude."""

from dataclasses import dataclass

import numpy as np

from perilune_render.config import FlightConfig
from perilune_render.streams import stream
from perilune_shared.geometry.descent import ROTATION_CAMERA_FROM_BODY, NominalDescent
from perilune_shared.geometry.frames import (
    Array,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)


@dataclass(frozen=True, slots=True)
class Flight:
    """The true motion of the camera over one descent of N frames."""

    nominal: NominalDescent
    """The curve that was meant."""
    time_s: Array
    """Since the first frame, seconds (N,)."""
    position_m: Array
    """Camera, O_L, metres (N, 3)."""
    velocity_mps: Array
    """Camera, O_L, metres per second (N, 3)."""
    rotation_wxyz: Array
    """rotation_camera_from_site as unit quaternions (N, 4), as the manifest keeps them."""

    @property
    def rotation_camera_from_site(self) -> Array:
        """Matrices (N, 3, 3), made of the quaternions, so that a manifest's pose is that of the rendering exactly."""
        return matrix_from_quaternion(self.rotation_wxyz)


def fly(config: FlightConfig, n_frames: int, seed: int) -> Flight:
    """The descent of a seed.

    Position and attitude depart from the nominal curve by independent stationary Gaussian processes with the kernel
    sigma^2 exp(-dt^2 / (2 tau^2)) on each axis (the paper gives "small perturbations with Gaussian distribution" and no
    sizes; white noise on each frame would be no motion that a lander can make). The velocity is the exact derivative,
    drawn jointly.
    """
    rng = stream(seed, "flight")
    azimuth = rng.uniform(config.azimuth_deg.low, config.azimuth_deg.high)
    nominal = NominalDescent.parabola(
        config.start_altitude_m, config.end_altitude_m, config.downrange_m, azimuth, config.duration_s
    )
    time = np.linspace(0, config.duration_s, n_frames)
    offset, rate = smooth_process(time, config.correlation_time_s, rng, 6)
    tilt = np.radians(config.attitude_sigma_deg) * offset[:, 3:]
    rotations = np.stack([ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(v).T for v in tilt])
    return Flight(
        nominal,
        time,
        nominal.position_at(time) + config.position_sigma_m * offset[:, :3],
        nominal.velocity_at(time) + config.position_sigma_m * rate[:, :3],
        np.stack([quaternion_from_matrix(rotation) for rotation in rotations]),
    )


def smooth_process(
    time_s: Array, correlation_time_s: float, rng: np.random.Generator, n_axes: int
) -> tuple[Array, Array]:
    """Values and time derivatives (N, n_axes) of unit-variance Gaussian processes with a squared-exponential kernel.

    Built from random Fourier features (Rahimi & Recht 2007), 256 waves an axis: unlike a Cholesky factor it is smooth
    at any frame rate, and its derivative is exact. The finite number of waves leaves the variance of one draw within
    about 5 % of the kernel's.
    """
    n_waves = 256
    omega = rng.normal(size=(n_axes, n_waves)) / correlation_time_s
    amplitude = rng.normal(size=(2, n_axes, n_waves)) / np.sqrt(n_waves)
    angle = time_s[:, None, None] * omega
    cos, sin = np.cos(angle), np.sin(angle)
    value = (amplitude[0] * cos + amplitude[1] * sin).sum(axis=2)
    derivative = (omega * (amplitude[1] * cos - amplitude[0] * sin)).sum(axis=2)
    return value, derivative
