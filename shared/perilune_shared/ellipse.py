"""Exact projection of circles in space to ellipses in the image.

A circle with centre c, radius r and normal n is the set c + r (cos t p + sin t q) with p, q spanning its plane. Its
image is the conic H^-T diag(1, 1, -1) H^-1 with H = K [r p, r q, c] (Hartley & Zisserman, Multiple View Geometry,
2nd ed., section 8.1; for craters Christian et al. 2021, doi 10.1007/s40295-021-00287-8). The image of the circle's
centre is not the centre of the ellipse.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.camera import Camera
from perilune_shared.frames import Array


@dataclass(frozen=True, slots=True)
class Ellipses:
    """N ellipses in the image; NaN where the circle has no elliptical image."""

    cx_px: Array
    """Centre, pixels from the left edge (N,)."""
    cy_px: Array
    """Centre, pixels from the top edge (N,)."""
    a_px: Array
    """Semi-major axis, pixels (N,)."""
    b_px: Array
    """Semi-minor axis, pixels (N,)."""
    theta_rad: Array
    """Direction of the semi-major axis, from x towards y, in [0, pi) (N,)."""

    def bounding_boxes(self) -> Array:
        """Tight boxes (N, 4) as x0, y0, x1, y1 in pixels, of the whole ellipse also where it leaves the image."""
        cos, sin = np.cos(self.theta_rad), np.sin(self.theta_rad)
        half_w = np.hypot(self.a_px * cos, self.b_px * sin)
        half_h = np.hypot(self.a_px * sin, self.b_px * cos)
        return np.stack([self.cx_px - half_w, self.cy_px - half_h, self.cx_px + half_w, self.cy_px + half_h], axis=-1)

    def radius_px(self) -> Array:
        """Radius of the circle of equal area, sqrt(a b), pixels (N,)."""
        return np.sqrt(self.a_px * self.b_px)


def plane_basis(normals: ArrayLike) -> tuple[Array, Array]:
    """Unit vectors p, q (N, 3) that span the planes of unit normals (N, 3): p, q, n right-handed."""
    n = np.asarray(normals, np.float64)
    helper = np.where(np.abs(n[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    p = np.cross(helper, n)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return p, np.cross(n, p)


def rim_points(centres_m: ArrayLike, normals: ArrayLike, radii_m: ArrayLike, n_points: int) -> Array:
    """Points (N, n_points, 3), evenly spaced on N circles with centres (N, 3), normals (N, 3), radii (N,)."""
    p, q = plane_basis(normals)
    angle = 2 * np.pi * np.arange(n_points) / n_points
    round_trip = np.cos(angle)[:, None] * p[:, None, :] + np.sin(angle)[:, None] * q[:, None, :]
    return np.asarray(centres_m)[:, None, :] + np.asarray(radii_m)[:, None, None] * round_trip


def project_circles(
    camera: Camera, centres_camera_m: ArrayLike, normals_camera: ArrayLike, radii_m: ArrayLike
) -> Ellipses:
    """Images of N circles given in O_C: centres (N, 3) metres, unit normals (N, 3), radii (N,) metres.

    NaN where the circle reaches behind the camera or is seen edge on, so that its image is no ellipse.
    """
    c, n = np.asarray(centres_camera_m, np.float64), np.asarray(normals_camera, np.float64)
    r = np.asarray(radii_m, np.float64)
    p, q = plane_basis(n)
    h = np.stack([r[:, None] * p, r[:, None] * q, c], axis=-1)
    # A circle whose nearest point is not in front of the camera has an open conic as image.
    nearest = c[:, 2] - r * np.hypot(p[:, 2], q[:, 2])
    edge_on = np.abs(np.einsum("ij,ij->i", n, c)) < 1e-9 * np.linalg.norm(c, axis=1)
    bad = (nearest <= 0) | edge_on
    h[bad] = np.eye(3)
    # The image is taken in coordinates centred on the circle's centre, else small far ellipses lose their digits.
    u0, v0 = (
        np.where(bad, 0, c[:, 0] / np.where(bad, 1, c[:, 2])),
        np.where(bad, 0, c[:, 1] / np.where(bad, 1, c[:, 2])),
    )
    calibration = np.zeros((len(c), 3, 3))
    calibration[:, 0, 0], calibration[:, 0, 2] = camera.fx_px, -camera.fx_px * u0
    calibration[:, 1, 1], calibration[:, 1, 2] = camera.fy_px, -camera.fy_px * v0
    calibration[:, 2, 2] = 1
    inverse = np.linalg.inv(calibration @ h)
    conic = np.swapaxes(inverse, 1, 2) @ np.diag([1.0, 1.0, -1.0]) @ inverse
    centre, axes, theta = _ellipse_of_conic(conic)
    values = [
        centre[:, 0] + camera.cx_px + camera.fx_px * u0,
        centre[:, 1] + camera.cy_px + camera.fy_px * v0,
        axes[:, 0],
        axes[:, 1],
        theta,
    ]
    for value in values:
        value[bad] = np.nan
    return Ellipses(*values)


def _ellipse_of_conic(conic: Array) -> tuple[Array, Array, Array]:
    """Centre (N, 2), semi-axes (N, 2) with a >= b, direction (N,) of conics (N, 3, 3)."""
    quadratic, linear = conic[:, :2, :2], conic[:, :2, 2]
    centre = -np.linalg.solve(quadratic, linear[:, :, None])[:, :, 0]
    constant = conic[:, 2, 2] + np.einsum("ij,ij->i", linear, centre)
    eigenvalues, vectors = np.linalg.eigh(quadratic)
    # The sign of a conic is free: both eigenvalues take the sign opposite to the constant.
    ratio = -constant[:, None] / eigenvalues
    axes = np.sqrt(ratio)
    swap = axes[:, 0] < axes[:, 1]
    axes = np.where(swap[:, None], axes[:, ::-1], axes)
    major = np.where(swap[:, None], vectors[:, :, 1], vectors[:, :, 0])
    return centre, axes, np.mod(np.arctan2(major[:, 1], major[:, 0]), np.pi)
