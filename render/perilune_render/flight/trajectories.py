"""Trajectories: the true motion of the camera at the times of the frames."""

from dataclasses import dataclass

import numpy as np

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.motion import Motion, draw_motion
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, quaternion_from_matrix
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
    motion: Motion | None = None
    """The motion between the frames; None if it is not known."""
    angular_velocity_radps: Array | None = None
    """Angular velocity of the camera, O_C, radians per second (N, 3); None if it does not rotate during a frame."""

    @property
    def rotation_camera_from_site(self) -> Array:
        """Matrices (N, 3, 3). They are computed from the quaternions, so a manifest has the rendered poses."""
        return matrix_from_quaternion(self.rotation_wxyz)


def fly(config: FlightConfig, n_frames: int, seed: int) -> Flight:
    """Draw the trajectory of a random seed, at `n_frames` evenly spaced times."""
    motion = draw_motion(config, seed)
    time = np.linspace(0, config.duration_s, n_frames)
    position, velocity, _ = motion.path_at(time)
    return Flight(
        motion.nominal,
        time,
        position,
        velocity,
        np.stack([quaternion_from_matrix(rotation) for rotation in motion.rotation_camera_from_site_at(time)]),
        motion,
    )
