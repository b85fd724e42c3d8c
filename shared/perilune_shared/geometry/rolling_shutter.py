"""Rolling shutter: rows of a frame are exposed one after the other while the camera moves and turns.

The camera keeps its velocity in O_L and its angular velocity in O_C. Time 0 is the middle of the exposure of the middle
row; the pose of a frame refers to this time. Row r of h rows is exposed at (r + 0.5 - h / 2) row_time_s.
"""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

_STEPS = 8
"""Number of fixed-point iterations that find the row of a point; each iteration reduces the error."""


@dataclass(frozen=True, slots=True)
class Moving:
    """Poses and velocities of N cameras: one camera for each of N points, or N = 1 for all points."""

    position_m: Array
    """Positions (N, 3) at time 0, O_L, metres."""
    rotation_camera_from_site: Array
    """Rotation matrices (N, 3, 3) at time 0."""
    velocity_mps: Array
    """Velocities (N, 3), O_L, metres per second."""
    angular_velocity_radps: Array
    """Angular velocities (N, 3), O_C, radians per second."""

    def rotations_at(self, time_s: Array) -> Array:
        """Return rotation_camera_from_site (N, 3, 3) at times (N,)."""
        # The camera turns by w t, so the scene turns by -w t in the axes of the camera.
        return _matrices(-time_s[:, None] * self.angular_velocity_radps) @ self.rotation_camera_from_site

    def seen_at(self, points_m: Array, time_s: Array) -> Array:
        """Transform points (N, 3), metres, from O_L to O_C at times (N,)."""
        offset = points_m - self.position_m - time_s[:, None] * self.velocity_mps
        return np.einsum("nij,nj->ni", self.rotations_at(time_s), offset)

    def row_times_s(self, points_m: Array, camera: Camera, row_time_s: float) -> Array:
        """Return the exposure time (N,), seconds, of the row that shows each point (N, 3) of O_L.

        Returns the time of the edge of the image for points above or below it, and 0 for points behind the camera.
        """
        half = camera.height_px / 2
        time = np.zeros(len(points_m))
        for _ in range(_STEPS):
            row = camera.project(self.seen_at(points_m, time))[:, 1] - half
            time = np.clip(np.nan_to_num(row), -half, half) * row_time_s
        return time


def _matrices(rotation_vectors_rad: Array) -> Array:
    """Return matrices (N, 3, 3) that rotate by |v| radians about v (N, 3) (Rodrigues' formula)."""
    angle = np.linalg.norm(rotation_vectors_rad, axis=-1)[:, None, None]
    x, y, z = rotation_vectors_rad.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    # sinc is exact at 0: sin(a) / a, and (1 - cos(a)) / a^2 = sinc(a / 2)^2 / 2.
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)
