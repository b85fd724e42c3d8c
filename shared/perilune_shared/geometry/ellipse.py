"""Project circles in space to ellipses in the image: exactly, or by a fit for distortion and lens models.

A circle with centre c, radius r and normal n is the set c + r (cos t p + sin t q), where p and q span its plane. Its
image is the conic H^-T diag(1, 1, -1) H^-1 with H = K [r p, r q, c] (Hartley & Zisserman, Multiple View Geometry,
2nd ed., section 8.1; for craters Christian et al. 2021, doi 10.1007/s40295-021-00287-8). The centre of the circle is
not projected to the centre of the ellipse. If the lens distorts, the image of a circle is not an ellipse, so an ellipse
is fitted to it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

_N_FITTED = 64
_ANGLES = 2 * np.pi * np.arange(_N_FITTED) / _N_FITTED
_UNIT_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)


@dataclass(frozen=True, slots=True)
class Ellipses:
    """N ellipses in the image; NaN where the image of a circle is not an ellipse."""

    cx_px: Array
    """Centres (N,), pixels from the left edge."""
    cy_px: Array
    """Centres (N,), pixels from the top edge."""
    a_px: Array
    """Semi-major axes (N,), pixels."""
    b_px: Array
    """Semi-minor axes (N,), pixels."""
    theta_rad: Array
    """Directions (N,) of the semi-major axes, from x towards y, in [0, pi)."""

    def bounding_boxes(self) -> Array:
        """Return the tight boxes (N, 4) x0, y0, x1, y1 of the ellipses, pixels, not clipped to the image."""
        cos, sin = np.cos(self.theta_rad), np.sin(self.theta_rad)
        half_w = np.hypot(self.a_px * cos, self.b_px * sin)
        half_h = np.hypot(self.a_px * sin, self.b_px * cos)
        return np.stack([self.cx_px - half_w, self.cy_px - half_h, self.cx_px + half_w, self.cy_px + half_h], axis=-1)

    def radius_px(self) -> Array:
        """Return the radii (N,) of the circles of equal area, sqrt(a b), pixels."""
        return np.sqrt(self.a_px * self.b_px)


def plane_basis(normals: ArrayLike) -> tuple[Array, Array]:
    """Return unit vectors p, q (N, 3) that span the planes with unit normals n (N, 3).

    The triple p, q, n is right-handed.
    """
    n = np.asarray(normals, np.float64)
    helper = np.where(np.abs(n[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    p = np.cross(helper, n)
    p /= np.linalg.norm(p, axis=-1, keepdims=True)
    return p, np.cross(n, p)


def rim_points(centres_m: ArrayLike, normals: ArrayLike, radii_m: ArrayLike, n_points: int) -> Array:
    """Return evenly spaced points (N, n_points, 3) on N circles.

    Circles have centres (N, 3), metres, unit normals (N, 3) and radii (N,), metres.
    """
    p, q = plane_basis(normals)
    angle = 2 * np.pi * np.arange(n_points) / n_points
    unit_circles = np.cos(angle)[:, None] * p[:, None, :] + np.sin(angle)[:, None] * q[:, None, :]
    return np.asarray(centres_m)[:, None, :] + np.asarray(radii_m)[:, None, None] * unit_circles


def project_circles(
    camera: Camera, centres_camera_m: ArrayLike, normals_camera: ArrayLike, radii_m: ArrayLike
) -> Ellipses:
    """Project N circles in O_C: centres (N, 3) and radii (N,) in metres, unit normals (N, 3).

    With distortion or a lens model, an ellipse is fitted to 64 points of the circle by least squares. The points are
    within 0.05 px of the ellipse for radii up to 50 px and distortions up to 5 px in the corners of 256 px images.
    Returns NaN if the image is not an ellipse: the circle reaches behind the camera, past the fold of the distortion or
    more than 90 degrees from the axis of a lens model, or is seen edge on.
    """
    c, n = np.asarray(centres_camera_m, np.float64), np.asarray(normals_camera, np.float64)
    r = np.asarray(radii_m, np.float64)
    p, q = plane_basis(n)
    # If the nearest point of the circle is not in front of the camera, the image is an open conic.
    nearest = c[:, 2] - r * np.hypot(p[:, 2], q[:, 2])
    edge_on = np.abs(np.einsum("ij,ij->i", n, c)) < 1e-9 * np.linalg.norm(c, axis=1)
    bad = (nearest <= 0) | edge_on
    if camera.distorts:
        points = camera.project(rim_points(c, n, r, _N_FITTED))
        bad |= np.isnan(points).any(axis=(1, 2))
        points[bad] = _UNIT_CIRCLE
        ellipses = fit_ellipses(points)
    else:
        ellipses = _exact(camera, c, np.stack([r[:, None] * p, r[:, None] * q, c], axis=-1), bad)
    values = [ellipses.cx_px, ellipses.cy_px, ellipses.a_px, ellipses.b_px, ellipses.theta_rad]
    return Ellipses(*(np.where(bad, np.nan, value) for value in values))


def _exact(camera: Camera, c: Array, h: Array, bad: Array) -> Ellipses:
    """Project circles without distortion; results are undefined where `bad` (N,) is true.

    `c` (N, 3) are the centres, `h` (N, 3, 3) the matrices [r p, r q, c].
    """
    h[bad] = np.eye(3)
    # Image coordinates relative to the projected centre keep the precision of small, distant ellipses.
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
    x, y = camera.cx_px + camera.fx_px * u0, camera.cy_px + camera.fy_px * v0
    return Ellipses(centre[:, 0] + x, centre[:, 1] + y, axes[:, 0], axes[:, 1], theta)


def fit_ellipses(points_px: ArrayLike) -> Ellipses:
    """Fit N ellipses to N sets of M points (N, M, 2), pixels, by direct least squares.

    The points are first shifted, rotated and scaled so that they are close to a unit circle. There the algebraic
    residual is about twice the distance, and the condition number does not depend on size, position or flatness.
    """
    points = np.asarray(points_px, np.float64)
    middle = points.mean(axis=1)
    offset = points - middle[:, None]
    variance, vectors = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset * (2 / points.shape[1]))
    whiten = vectors.swapaxes(1, 2) / np.sqrt(variance)[:, :, None]
    x, y = np.moveaxis(offset @ whiten.swapaxes(1, 2), -1, 0)
    terms = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    normal = terms.swapaxes(1, 2) @ terms
    a, b, c, d, e = np.linalg.solve(normal, terms.sum(axis=1)[:, :, None])[:, :, 0].T
    conic = np.empty((len(points), 3, 3))
    conic[:, 0, 0], conic[:, 1, 1], conic[:, 2, 2] = a, c, -1.0
    conic[:, 0, 1] = conic[:, 1, 0] = b / 2
    conic[:, 0, 2] = conic[:, 2, 0] = d / 2
    conic[:, 1, 2] = conic[:, 2, 1] = e / 2
    back = np.zeros((len(points), 3, 3))
    back[:, :2, :2], back[:, 2, 2] = whiten, 1.0
    # A strongly curved image of a circle may be fitted by a hyperbola, whose axes are NaN.
    with np.errstate(invalid="ignore"):
        centre, axes, theta = _ellipse_of_conic(back.swapaxes(1, 2) @ conic @ back)
    return Ellipses(centre[:, 0] + middle[:, 0], centre[:, 1] + middle[:, 1], axes[:, 0], axes[:, 1], theta)


def _ellipse_of_conic(conic: Array) -> tuple[Array, Array, Array]:
    """Return centre (N, 2), semi-axes (N, 2) with a >= b and direction (N,) of conics (N, 3, 3)."""
    quadratic, linear = conic[:, :2, :2], conic[:, :2, 2]
    centre = -np.linalg.solve(quadratic, linear[:, :, None])[:, :, 0]
    constant = conic[:, 2, 2] + np.einsum("ij,ij->i", linear, centre)
    eigenvalues, vectors = np.linalg.eigh(quadratic)
    # A conic is defined up to its sign; for an ellipse both eigenvalues have the sign opposite to the constant.
    ratio = -constant[:, None] / eigenvalues
    axes = np.sqrt(ratio)
    swap = axes[:, 0] < axes[:, 1]
    axes = np.where(swap[:, None], axes[:, ::-1], axes)
    major = np.where(swap[:, None], vectors[:, :, 1], vectors[:, :, 0])
    return centre, axes, np.mod(np.arctan2(major[:, 1], major[:, 0]), np.pi)
