"""Perturbed trajectories: a nominal parabola plus smooth Gaussian perturbations of position and attitude."""

from dataclasses import dataclass

import numpy as np

from perilune_render.config import FlightConfig
from perilune_render.streams import stream
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import (
    Array,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
)
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory


@dataclass(frozen=True, slots=True)
class Flight:
    """True motion of the camera along one trajectory of N frames."""

    nominal: NominalTrajectory
    """Nominal parabola."""
    time_s: Array
    """Time since the first frame, seconds (N,)."""
    position_m: Array
    """Position of the camera, O_L, metres (N, 3)."""
    velocity_mps: Array
    """Velocity of the camera, O_L, metres per second (N, 3)."""
    rotation_wxyz: Array
    """rotation_camera_from_site as unit quaternions (N, 4), as stored in the manifest."""

    @property
    def rotation_camera_from_site(self) -> Array:
        """Matrices (N, 3, 3), computed from the quaternions, so that the manifest holds exactly the rendered pose."""
        return matrix_from_quaternion(self.rotation_wxyz)


def fly(config: FlightConfig, n_frames: int, seed: int) -> Flight:
    """Draw the trajectory of a random seed.

    Position and attitude deviate from the nominal motion by independent stationary Gaussian processes with the kernel
    sigma^2 exp(-dt^2 / (2 tau^2)) on each axis. The paper states "small perturbations with Gaussian distribution"
    without sizes; white noise on each frame would not be a possible motion of a lander. The velocity is the exact
    derivative of the position.
    """
    rng = stream(seed, "flight")
    azimuth = rng.uniform(config.azimuth_deg.low, config.azimuth_deg.high)
    nominal = NominalTrajectory.parabola(
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

    Built from random Fourier features (Rahimi & Recht 2007), 256 waves per axis. Unlike samples from a Cholesky factor
    they are smooth at any frame rate, and their derivative is exact. With the finite number of waves the variance of
    one draw is within about 5 % of the kernel's.
    """
    n_waves = 256
    omega = rng.normal(size=(n_axes, n_waves)) / correlation_time_s
    amplitude = rng.normal(size=(2, n_axes, n_waves)) / np.sqrt(n_waves)
    angle = time_s[:, None, None] * omega
    cos, sin = np.cos(angle), np.sin(angle)
    value = (amplitude[0] * cos + amplitude[1] * sin).sum(axis=2)
    derivative = (omega * (amplitude[1] * cos - amplitude[0] * sin)).sum(axis=2)
    return value, derivative
