"""The pinhole camera.

Theory: a point X in O_L goes to the camera by x_C = rotation_camera_from_site (X - position_m), and to the image by
u = fx x/z + cx, v = fy y/z + cy. Image coordinates have their origin at the outer corner of the top-left pixel, so
pixel (column i, row j) covers [i, i+1) x [j, j+1) and its centre lies at (i + 0.5, j + 0.5); cx = width / 2 is the
middle of the image.

Use: `camera.project(points)` and its inverse `camera.rays(pixels) * depth`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.frames import Array


@dataclass(frozen=True, slots=True)
class Camera:
    """Intrinsics of a distortion-free pinhole camera."""

    width_px: int
    """Image width, pixels."""
    height_px: int
    """Image height, pixels."""
    fx_px: float
    """Focal length over the pixel's width, pixels."""
    fy_px: float
    """Focal length over the pixel's height, pixels."""
    cx_px: float
    """Principal point, pixels right of the left edge."""
    cy_px: float
    """Principal point, pixels below the top edge."""

    @classmethod
    def from_field_of_view(cls, width_px: int, height_px: int, horizontal_fov_deg: float) -> "Camera":
        """A camera with square pixels and a centred principal point."""
        f = width_px / 2 / np.tan(np.radians(horizontal_fov_deg) / 2)
        return cls(width_px, height_px, float(f), float(f), width_px / 2, height_px / 2)

    @property
    def matrix(self) -> Array:
        """Calibration matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def project(self, points_camera_m: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in O_C; NaN where the point is not in front of the camera."""
        p = np.asarray(points_camera_m, np.float64)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        return np.stack([self.fx_px * p[..., 0] / z + self.cx_px, self.fy_px * p[..., 1] / z + self.cy_px], axis=-1)

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions (..., 3) in O_C with z = 1 through pixels (..., 2): times a depth along the axis, points."""
        uv = np.asarray(pixels, np.float64)
        x = (uv[..., 0] - self.cx_px) / self.fx_px
        y = (uv[..., 1] - self.cy_px) / self.fy_px
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def pixel_centres(self) -> Array:
        """Image coordinates (height, width, 2) of all pixel centres."""
        u, v = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([u, v], axis=-1)

    def inside(self, pixels: ArrayLike) -> np.ndarray:
        """Whether pixels (..., 2) lie in the image; NaN does not."""
        uv = np.asarray(pixels, np.float64)
        return (uv[..., 0] >= 0) & (uv[..., 0] < self.width_px) & (uv[..., 1] >= 0) & (uv[..., 1] < self.height_px)


def camera_from_site(points_site_m: ArrayLike, position_m: ArrayLike, rotation_camera_from_site: ArrayLike) -> Array:
    """Points (..., 3) of O_L in O_C, for a camera at position_m (3,)."""
    offset = np.asarray(points_site_m, np.float64) - np.asarray(position_m, np.float64)
    return offset @ np.asarray(rotation_camera_from_site, np.float64).T
