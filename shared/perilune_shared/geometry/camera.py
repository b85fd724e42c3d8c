"""Camera models: a pinhole with optional lens distortion, and the lens models of `lens_models`.

A point X in O_L has the camera coordinates x_C = rotation_camera_from_site (X - position_m) and the image coordinates
u = fx x' + cx, v = fy y' + cy. Without distortion x' = a = x/z and y' = b = y/z. With distortion, after Brown (1966)
and Conrady (1919) in OpenCV's form, with r^2 = a^2 + b^2 and s = 1 + k1 r^2 + k2 r^4 + k3 r^6,
x' = a s + 2 p1 a b + p2 (r^2 + 2 a^2) and y' = b s + p1 (r^2 + 2 b^2) + 2 p2 a b.

With another `model` than `pinhole`, x' and y' follow from `lens_models`: fisheye, unified, CAHVOR or CAHVORE. Then
u = fx x' + skew y' + cx. The unified model applies the Brown-Conrady distortion to a and b, with a = x / (z + xi |X|)
and b = y / (z + xi |X|).

Image coordinates have their origin at the outer corner of the top-left pixel, so pixel (column i, row j) covers
[i, i+1) x [j, j+1) and its centre lies at (i + 0.5, j + 0.5); cx = width / 2 is the middle of the image.

Use: `camera.project(points)` and its inverse `camera.points(pixels, depth)`. The depth of a pinhole is measured along
its axis, and its rays have z = 1. The depth of a lens model is the distance along the ray, and its rays have length 1.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.lens_models import Lens, lens_of

Distortion = tuple[float, float, float, float, float]
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
ROTATION_CAMERA_FROM_BODY = np.diag([1.0, -1.0, -1.0])
"""Default mounting: the camera looks along -Z_B, and its x axis points along X_B.

For a level body this is the viewing direction in the paper by Song et al., "along the negative axis of Z_L"."""
_MAX_UNDISTORTION_ERROR = 1e-10
"""Maximum error of `rays`, in coordinates divided by the focal length."""
_FARTHEST = 1e100
"""Radius at which the search for the edge of an image ends, if the coefficients hide the fold."""
_N_FOLD = 721
"""Number of angles at which tangential distortion is tested for a fold."""


@dataclass(frozen=True, slots=True)
class Camera:
    """Camera intrinsics."""

    width_px: int
    """Image width, pixels."""
    height_px: int
    """Image height, pixels."""
    fx_px: float
    """Focal length divided by the pixel width, pixels."""
    fy_px: float
    """Focal length divided by the pixel height, pixels."""
    cx_px: float
    """Principal point, pixels right of the left edge."""
    cy_px: float
    """Principal point, pixels below the top edge."""
    distortion: Distortion = NO_DISTORTION
    """Brown-Conrady k1, k2, p1, p2, k3, for coordinates divided by the focal length."""
    model: str = "pinhole"
    """pinhole, or a lens model of `lens_models.PARAMETERS`."""
    parameters: tuple[float, ...] = ()
    """Parameters of the lens model, in the order of `lens_models.PARAMETERS`; none for a pinhole."""

    @classmethod
    def from_field_of_view(cls, width_px: int, height_px: int, horizontal_fov_deg: float) -> "Camera":
        """Create a camera with square pixels and a centred principal point."""
        f = width_px / 2 / np.tan(np.radians(horizontal_fov_deg) / 2)
        return cls(width_px, height_px, float(f), float(f), width_px / 2, height_px / 2)

    @property
    def lens(self) -> Lens | None:
        """The lens model; None for a pinhole."""
        return None if self.model == "pinhole" else lens_of(self.model, self.parameters)

    @property
    def distorts(self) -> bool:
        """Whether straight lines have curved images: distortion, or a lens model."""
        return self.model != "pinhole" or any(self.distortion)

    @property
    def scale_px(self) -> float:
        """Pixels per radian: fx of a pinhole; the largest number in the image of a lens model."""
        return self.fx_px if self.model == "pinhole" else _finest_px(self)

    @property
    def matrix(self) -> Array:
        """Calibration matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def project(self, points_camera_m: ArrayLike) -> Array:
        """Project points (..., 3) in O_C, metres, to image coordinates (..., 2), pixels.

        Returns NaN for a point that is not in front of the camera, or so far off the axis that the distortion folds
        back. A lens model has an image up to 90 degrees from its axis.
        """
        p = np.asarray(points_camera_m, np.float64)
        lens = self.lens
        if lens is not None:
            x, y = lens.image(p)
            if any(self.distortion):
                x, y = self._distorted(x, y)
            return np.stack([self.fx_px * x + lens.skew_px * y + self.cx_px, self.fy_px * y + self.cy_px], axis=-1)
        z = np.where(p[..., 2] > 0, p[..., 2], np.nan)
        x, y = p[..., 0] / z, p[..., 1] / z
        if any(self.distortion):
            x, y = self._distorted(x, y)
        return np.stack([self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px], axis=-1)

    def rays(self, pixels: ArrayLike) -> Array:
        """Return rays (..., 3), O_C, through image coordinates (..., 2), pixels: z = 1, or length 1 of a lens model.

        A ray times a depth is a point (of CAHVORE: relative to `ray_starts`). The distortion is inverted with an error
        below 1e-10, in coordinates divided by the focal length. Returns NaN if no ray reaches the pixel before the
        distortion folds back, or within 90 degrees of the axis of a lens model.
        """
        if self.model != "pinhole":
            return self.rays_and_starts(pixels)[0]
        uv = np.asarray(pixels, np.float64)
        x = (uv[..., 0] - self.cx_px) / self.fx_px
        y = (uv[..., 1] - self.cy_px) / self.fy_px
        if any(self.distortion):
            x, y = self._undistorted(x, y)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def ray_starts(self, pixels: ArrayLike) -> Array:
        """Return the points (..., 3), O_C, metres, where the rays through image coordinates (..., 2) start.

        They are 0 except for CAHVORE with E, whose entrance pupil moves along the axis.
        """
        lens = self.lens
        if lens is None or lens.is_central:
            return np.zeros((*np.shape(pixels)[:-1], 3))
        return self.rays_and_starts(pixels)[1]

    def rays_and_starts(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return `rays` and `ray_starts` (..., 3) of image coordinates (..., 2), pixels."""
        lens = self.lens
        if lens is None:
            return self.rays(pixels), self.ray_starts(pixels)
        x, y = self._normalised(pixels)
        if any(self.distortion):
            x, y = self._undistorted(x, y)
        rays, pupil_m = lens.directions(x, y)
        return rays, pupil_m[..., None] * lens.axis

    def points(self, pixels: ArrayLike, depth_m: ArrayLike) -> Array:
        """Return the points (..., 3), O_C, metres, at image coordinates (..., 2), pixels, and depths (...), metres."""
        if self.model == "pinhole":
            return self.rays(pixels) * np.asarray(depth_m)[..., None]
        rays, starts = self.rays_and_starts(pixels)
        return rays * np.asarray(depth_m)[..., None] + starts

    def depth_m(self, points_camera_m: Array) -> Array:
        """Return the depths (...) of points (..., 3), O_C, metres: z, or the distance for a lens model."""
        if self.model == "pinhole":
            return points_camera_m[..., 2]
        return np.linalg.norm(points_camera_m, axis=-1)

    def border_rays(self, pixels: ArrayLike) -> Array:
        """Return `rays`; where a lens model has no ray, the ray 90 degrees from z on the same side of the image."""
        rays = self.rays(pixels)
        if self.model == "pinhole":
            return rays
        offset = (np.asarray(pixels, np.float64) - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        with np.errstate(invalid="ignore"):
            side = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
        return np.where(np.isnan(rays), np.concatenate([side, 0 * side[..., :1]], axis=-1), rays)

    def pixel_centres(self) -> Array:
        """Return the image coordinates (height, width, 2), pixels, of all pixel centres."""
        u, v = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([u, v], axis=-1)

    def inside(self, pixels: ArrayLike) -> np.ndarray:
        """Whether image coordinates (..., 2), pixels, are inside the image; false for NaN."""
        uv = np.asarray(pixels, np.float64)
        return (uv[..., 0] >= 0) & (uv[..., 0] < self.width_px) & (uv[..., 1] >= 0) & (uv[..., 1] < self.height_px)

    def outline(self) -> Array:
        """Return image coordinates (M, 2), pixels, along the edge of the image, half a pixel apart."""
        u, v = (np.linspace(0, size, 2 * size + 1) for size in (self.width_px, self.height_px))
        sides = [(u, 0 * u), (u, 0 * u + self.height_px), (0 * v, v), (0 * v + self.width_px, v)]
        return np.concatenate([np.stack(side, axis=-1) for side in sides])

    def folds_back(self) -> bool:
        """Whether the distortion or the lens model folds back inside the image, so that some pixels have no ray."""
        lens = self.lens
        if lens is None:
            return bool(np.isnan(self.rays(self.outline())).any())
        x, y = self._normalised(self.outline())
        if any(self.distortion):
            # Beyond 90 degrees there are no rays, so a fold there does no harm.
            if self.fold_angle_deg >= 90:
                return False
            return bool(np.isnan(self._undistorted(x, y)).any())
        if lens.fold_rad == np.inf:
            return False
        d = np.stack([x, y, np.ones_like(x)], axis=-1)
        axial = d @ lens.axis
        across = np.linalg.norm(d - axial[..., None] * lens.axis, axis=-1)
        return bool((across >= lens.table[1, -1] * axial).any())

    @property
    def fold_angle_deg(self) -> float:
        """Angle from the axis at which the image stops growing and folds back, degrees; infinite if it never does."""
        lens, angle = self.lens, np.inf
        if any(self.distortion) and np.isfinite(radius := _fold_radius(self.distortion)):
            angle = float(np.arctan(radius)) if lens is None else float(lens.angle(np.array(radius)))
        if lens is not None:
            angle = lens.fold_rad if np.isnan(angle) else min(angle, lens.fold_rad)
        if any(self.distortion[2:4]):
            angle = min(angle, self._tangential_fold_rad())
        return float(np.degrees(angle))

    def _tangential_fold_rad(self) -> float:
        """Return the smallest of _N_FOLD angles from the axis at which distortion mirrors the image, or infinity."""
        theta, turn = np.linspace(0, np.pi / 2 - 1e-6, _N_FOLD), np.linspace(0, 2 * np.pi, 73)[:-1]
        r = np.tan(theta) if self.lens is None else self.lens.radius(theta)
        with np.errstate(all="ignore"):
            xx, xy, yy = self._jacobian(r[:, None] * np.cos(turn), r[:, None] * np.sin(turn))
            folded = ~(xx * yy > xy * xy).all(axis=1)
        return float(theta[np.argmax(folded)]) if folded.any() else np.inf

    def rendered(self) -> "Camera":
        """Return the camera in whose pixels an engine renders: this camera, or the pinhole that covers a distortion."""
        return self.covering_pinhole() if self.model == "pinhole" else self

    def covering_pinhole(self) -> "Camera":
        """Return a camera without distortion that covers the whole view of this camera.

        The focal lengths are equal; the image is larger by whole pixels on each side where needed. Returns this camera
        if it has no distortion. Raises ValueError if the distortion folds back inside the image, or for a lens model.
        """
        if self.model != "pinhole":
            raise ValueError(f"no pinhole covers a camera of the model {self.model}")
        if not any(self.distortion):
            return self
        if self.folds_back():
            raise ValueError("the distortion folds back within the image")
        pinhole = replace(self, distortion=NO_DISTORTION)
        seen = pinhole.project(self.rays(self.outline()))
        left, top = (int(np.ceil(max(0.0, -low))) for low in seen.min(axis=0))
        size = np.array([self.width_px, self.height_px])
        right, bottom = (int(np.ceil(max(0.0, more))) for more in seen.max(axis=0) - size)
        return replace(
            pinhole,
            width_px=self.width_px + left + right,
            height_px=self.height_px + top + bottom,
            cx_px=self.cx_px + left,
            cy_px=self.cy_px + top,
        )

    def covers(self, other: "Camera") -> bool:
        """Whether every ray of the other camera's pixels falls inside this camera's image."""
        if self == other:
            return True
        seen = self.project(other.rays(other.outline()))
        return bool((seen >= -1e-6).all() and (seen <= np.array([self.width_px, self.height_px]) + 1e-6).all())

    def _normalised(self, pixels: ArrayLike) -> tuple[Array, Array]:
        """Return x' and y' (...) of image coordinates (..., 2), pixels."""
        uv, lens = np.asarray(pixels, np.float64), self.lens
        y = (uv[..., 1] - self.cy_px) / self.fy_px
        skew = 0.0 if lens is None else lens.skew_px * y
        return (uv[..., 0] - self.cx_px - skew) / self.fx_px, y

    def _distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return distorted coordinates, or NaN where the distortion has folded back.

        It has folded back beyond the fold of its radial part, or where its Jacobian determinant is not positive.
        """
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xx, xy, yy = self._jacobian(x, y)
        beyond = (r2 >= _fold_radius(self.distortion) ** 2) | (xx * yy <= xy * xy)
        nan = np.where(beyond, np.nan, 0.0)
        return (
            x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + nan,
            y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + nan,
        )

    def _jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives dx'/dx, dx'/dy = dy'/dx and dy'/dy of the distortion."""
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        return (
            scale + slope * x * x + 2 * p1 * y + 6 * p2 * x,
            slope * x * y + 2 * p1 * x + 2 * p2 * y,
            scale + slope * y * y + 6 * p1 * y + 2 * p2 * x,
        )

    def _undistorted(self, target_x: Array, target_y: Array) -> tuple[Array, Array]:
        """Invert the distortion by Newton's method, starting from a table of the radial part inside the fold."""
        target_r = np.hypot(target_x, target_y)
        radial = self._radial_table(float(np.nanmax(target_r, initial=0.0)))
        start = np.interp(target_r, radial[1], radial[0]) / np.maximum(target_r, 1e-300)
        x, y = target_x * start, target_y * start
        for _ in range(20):
            got_x, got_y = self._distorted(x, y)
            off_x, off_y = target_x - got_x, target_y - got_y
            # A point exactly on the fold cannot be inverted; it stays NaN.
            if not (np.maximum(np.abs(off_x), np.abs(off_y)) > 1e-2 * _MAX_UNDISTORTION_ERROR).any():
                break
            xx, xy, yy = self._jacobian(x, y)
            determinant = xx * yy - xy * xy
            x = x + (yy * off_x - xy * off_y) / determinant
            y = y + (xx * off_y - xy * off_x) / determinant
        got_x, got_y = self._distorted(x, y)
        converged = np.maximum(np.abs(target_x - got_x), np.abs(target_y - got_y)) < _MAX_UNDISTORTION_ERROR
        return np.where(converged, x, np.nan), np.where(converged, y, np.nan)

    def _radial_table(self, largest: float) -> Array:
        """Return ascending radii before and after radial distortion (2, 2000), up to `largest` or the fold."""
        k1, k2, _, _, k3 = self.distortion
        fold = _fold_radius(self.distortion)
        end = min(fold, 1.0)
        while end < min(fold, _FARTHEST) and end * (1 + end**2 * (k1 + end**2 * (k2 + end**2 * k3))) < largest:
            end = min(2 * end, fold)
        r = np.linspace(0, end, 2000, endpoint=False)
        r2 = r * r
        return np.stack([r, r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))])


@lru_cache
def _fold_radius(distortion: Distortion) -> float:
    """Return the smallest r > 0 where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing, or infinity."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    turns = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(np.sqrt(turns.min())) if len(turns) else np.inf


@lru_cache(maxsize=64)
def _finest_px(camera: Camera) -> float:
    """Return the largest number of pixels per radian in the image of a lens model, sampled at 65 x 65 places.

    Returns NaN if no place has a ray.
    """
    u, v = (np.linspace(0, size - 0.5, 65) for size in (camera.width_px, camera.height_px))
    places = np.stack(np.meshgrid(u, v), axis=-1)
    rays = camera.rays(places)
    steps = [np.linalg.norm(camera.rays(places + step) - rays, axis=-1) for step in ([0.5, 0.0], [0.0, 0.5])]
    seen = np.isfinite(steps)
    return float(0.5 / np.min(steps, where=seen, initial=np.inf)) if seen.any() else np.nan


def camera_from_site(points_site_m: ArrayLike, position_m: ArrayLike, rotation_camera_from_site: ArrayLike) -> Array:
    """Transform points (..., 3) from O_L to O_C, metres, for a camera at `position_m` (3,), O_L."""
    offset = np.asarray(points_site_m, np.float64) - np.asarray(position_m, np.float64)
    return offset @ np.asarray(rotation_camera_from_site, np.float64).T
