"""The true motion of the lander at any time: a nominal parabola plus smooth Gaussian perturbations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_render.config.dataset import FlightConfig
from perilune_render.streams import stream
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory

_N_WAVES = 256
"""Number of random waves in each smooth process."""
_MAX_DRAWS = 1000
"""Largest number of draws to find a motion within `flight.max_perturbation_mps2`."""
_STEP = 2 * np.pi / 20
"""Time step for checking the acceleration of a draw, as phase of its fastest wave, radians."""


@dataclass(frozen=True, slots=True)
class SmoothProcess:
    """A draw of K independent stationary processes of unit variance.

    The kernel is exp(-dt^2 / (2 tau^2)). Each process is a sum of 256 random waves (random Fourier features, Rahimi &
    Recht 2007). Unlike samples from a Cholesky factor, the sum is smooth at any frame rate, and its derivatives are
    exact. Since the number of waves is finite, the variance of one draw deviates from the kernel's by up to about 5 %.
    """

    omega_radps: Array
    """Angular frequencies of the waves (K, 256), radians per second."""
    amplitude: Array
    """Amplitudes of cosines and sines (2, K, 256)."""

    @classmethod
    def draw(cls, correlation_time_s: ArrayLike, rng: np.random.Generator) -> "SmoothProcess":
        """Draw processes with the correlation times tau (K,), seconds."""
        tau = np.asarray(correlation_time_s, np.float64)[:, None]
        omega = rng.normal(size=(len(tau), _N_WAVES)) / tau
        return cls(omega, rng.normal(size=(2, len(tau), _N_WAVES)) / np.sqrt(_N_WAVES))

    def part(self, axes: slice) -> "SmoothProcess":
        """A selection of the processes."""
        return SmoothProcess(self.omega_radps[axes], self.amplitude[:, axes])

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Values, first and second time derivatives, (N, K) each, at times (N,), seconds."""
        angle = np.asarray(time_s)[:, None, None] * self.omega_radps
        cos, sin = np.cos(angle), np.sin(angle)
        waves = self.amplitude[0] * cos + self.amplitude[1] * sin
        rate = (self.omega_radps * (self.amplitude[1] * cos - self.amplitude[0] * sin)).sum(axis=2)
        return waves.sum(axis=2), rate, -(self.omega_radps**2 * waves).sum(axis=2)


@dataclass(frozen=True, slots=True)
class Motion:
    """Position and attitude of the lander as functions of time.

    Position and attitude deviate from the nominal motion by independent stationary Gaussian processes with the kernel
    sigma^2 exp(-dt^2 / (2 tau^2)) on each axis. The paper of Song et al. states "small perturbations with Gaussian
    distribution" without sizes. White noise on each frame would not be a possible motion of a lander.
    """

    nominal: NominalTrajectory
    """Nominal parabola."""
    position_sigma_m: float
    """Standard deviation of the perturbation of the position, per axis, metres."""
    attitude_sigma_rad: float
    """Standard deviation of the perturbation of the attitude, per axis, radians."""
    position_process: SmoothProcess
    """Perturbation of the position, three axes of unit variance."""
    attitude_process: SmoothProcess
    """Perturbation of the attitude, three axes of unit variance."""
    rotation_site_from_nominal: Array | None = None
    """Nominal attitude, the rotation (3, 3) from O_B to O_L without perturbation; None if it is level."""

    def path_at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Positions (N, 3), metres, velocities, metres per second, and accelerations, O_L, at times (N,).

        Velocity and acceleration are the exact derivatives of the position.
        """
        offset, rate, second = self.position_process.at(time_s)
        return (
            self.nominal.position_at(time_s) + self.position_sigma_m * offset,
            self.nominal.velocity_at(time_s) + self.position_sigma_m * rate,
            np.array(self.nominal.acceleration_mps2) + self.position_sigma_m * second,
        )

    def largest_perturbation_mps2(self) -> float:
        """Largest acceleration of the perturbation during the trajectory, metres per second squared.

        Evaluated at 20 or more steps in the period of each wave.
        """
        step_s = _STEP / np.abs(self.position_process.omega_radps).max()
        _, _, second = self.position_process.at(np.arange(0, self.nominal.duration_s, step_s))
        return float(self.position_sigma_m * np.linalg.norm(second, axis=1).max())

    def rotation_site_from_body_at(self, time_s: Array) -> Array:
        """Rotations from O_B to O_L (N, 3, 3) at times (N,)."""
        turn = self.attitude_sigma_rad * self.attitude_process.at(time_s)[0]
        rotation = np.stack([matrix_from_rotation_vector(v) for v in turn])
        return rotation if self.rotation_site_from_nominal is None else rotation @ self.rotation_site_from_nominal

    def rotation_camera_from_site_at(self, time_s: Array) -> Array:
        """Rotations from O_L to O_C (N, 3, 3) at times (N,)."""
        return np.stack([ROTATION_CAMERA_FROM_BODY @ r.T for r in self.rotation_site_from_body_at(time_s)])


def draw_motion(config: FlightConfig, seed: int) -> Motion:
    """Draw the motion of a lander from a random seed.

    With `max_perturbation_mps2`, motions are drawn until the acceleration of the perturbation never exceeds this limit.
    Raises UserError if all of a thousand draws exceed it.
    """
    rng = stream(seed, "flight")
    azimuth = rng.uniform(config.azimuth_deg.low, config.azimuth_deg.high)
    nominal = NominalTrajectory.parabola(
        config.start_altitude_m, config.end_altitude_m, config.downrange_m, azimuth, config.duration_s
    )
    sigmas = config.position_sigma_m, float(np.radians(config.attitude_sigma_deg))
    correlation_s = np.repeat([config.correlation_time_s, config.attitude_correlation_s], 3)
    limit, attitude = config.max_perturbation_mps2, _drawn_attitude(config, azimuth, seed)
    for number in range(_MAX_DRAWS):
        process = SmoothProcess.draw(correlation_s, rng)
        motion = Motion(nominal, *sigmas, process.part(slice(0, 3)), process.part(slice(3, 6)), attitude)
        if limit is None or motion.largest_perturbation_mps2() <= limit:
            return motion
        rng = stream(seed, "flight", number)
    expected = "a larger limit, a smaller position_sigma_m, or a longer correlation_time_s"
    raise UserError("configuration", "flight.max_perturbation_mps2", limit, expected)


def _drawn_attitude(config: FlightConfig, azimuth_deg: float, seed: int) -> Array | None:
    """Draw the nominal attitude of a trajectory that comes from `azimuth_deg`; None for a flight without tilt.

    The body is turned from the level attitude about a horizontal axis. Tilt and direction have separate random streams.
    """
    if not config.is_oblique:
        return None
    angle, around = config.off_nadir_deg, config.off_nadir_azimuth_deg
    off_nadir = np.radians(stream(seed, "off_nadir").uniform(angle.low, angle.high))
    heading = np.radians(azimuth_deg + 180 + stream(seed, "off_nadir_azimuth").uniform(around.low, around.high))
    towards = np.array([-np.sin(heading), -np.cos(heading), 0.0])
    return matrix_from_rotation_vector(off_nadir * np.cross([0.0, 0.0, -1.0], towards))
