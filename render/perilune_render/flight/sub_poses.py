"""Poses of the camera during one frame, for rolling shutter and motion blur.

The velocity in O_L and the angular velocity in O_C are constant during a frame. Times are seconds from the middle of
the exposure of the middle row, to which the pose of a frame refers. The engine renders in the pixels of its own camera,
a pinhole (`exr_camera`) that covers the view of the sensor's camera.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector

Pose = tuple[Array, Array]
"""Position of the camera, O_L, metres (3,), and rotation_camera_from_site (3, 3)."""
_SKY_M = 1e9
"""Depth assumed for pixels that show the sky, metres."""


def moved(pose: Pose, velocity_mps: Array, angular_velocity_radps: Array, time_s: float) -> Pose:
    """A pose moved by time_s: velocity (3,) in O_L, angular velocity (3,) of the camera in O_C."""
    position, rotation = pose
    # The camera rotates by w t in its axes, so the scene in camera axes rotates by -w t.
    return position + time_s * velocity_mps, matrix_from_rotation_vector(-time_s * angular_velocity_radps) @ rotation


@dataclass(frozen=True, slots=True)
class RowPoses:
    """Poses of the rows of one frame with a rolling shutter of N rows."""

    row: np.ndarray
    """Row of the sensor, from 0, in which each pixel of the engine's camera appears (h, w) int64."""
    time_s: Array
    """Time of the middle of each row's exposure (N,)."""
    pose_at: Callable[[float], Pose]
    """Function from a time, seconds, to the pose."""

    def bands(self, n_bands: int) -> list[tuple[np.ndarray, Pose]]:
        """Pixels (h, w) bool of `n_bands` bands of neighbouring rows, and the pose at each band's mean time."""
        band = np.arange(len(self.time_s)) * n_bands // len(self.time_s)
        of_pixel = band[self.row]
        return [(of_pixel == k, self.pose_at(float(self.time_s[band == k].mean()))) for k in range(n_bands)]

    def motion_px(self, depth_m: np.ndarray, camera: Camera) -> float:
        """Largest motion in the image of the engine's `camera` between the exposures of the first and last row, pixels.

        depth_m (h, w) is the depth at the middle pose.
        """
        position, rotation = self.pose_at(0.0)
        points = camera.points(camera.pixel_centres(), np.where(np.isfinite(depth_m), depth_m, _SKY_M))
        points = points @ rotation + position
        first, last = (
            camera.project(camera_from_site(points, *self.pose_at(float(self.time_s[end])))) for end in (0, -1)
        )
        return float(np.nan_to_num(np.linalg.norm(last - first, axis=-1)).max())


def row_times_s(n_rows: int, row_time_s: float) -> Array:
    """Time of the middle of each row's exposure (n_rows,), seconds; their mean is 0."""
    return (np.arange(n_rows) + 0.5 - n_rows / 2) * row_time_s


def sensor_rows(camera: Camera, exr_camera: Camera) -> np.ndarray:
    """Row of the sensor in which each pixel of the engine's camera `exr_camera` appears (h, w) int64.

    `camera` is the sensor's camera. Pixels outside its image get the nearest row.
    """
    if camera == exr_camera:
        return np.tile(np.arange(camera.height_px)[:, None], camera.width_px)
    row = camera.project(exr_camera.rays(exr_camera.pixel_centres()))[..., 1]
    # Far outside the image the distortion may fold back; those pixels are not used.
    return np.clip(np.floor(np.nan_to_num(row)), 0, camera.height_px - 1).astype(np.int64)
