"""Measure the rim crests of catalogued craters in an elevation model.

A catalogue often gives the diameter at formation, or a diameter marked by hand on an image; worn rims lie farther out.
In each of 36 directions, the crest is the highest place of the height profile from the centre outwards, above a plane
fitted to the ground around the crater. An ellipse through the 36 places gives centre and diameter.
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.terrain.elevation.model import ElevationModel, raster_places
from perilune_shared.geometry.frames import Array

MIN_PIXELS = 8.0
"""Smallest diameter for which a crest is measured, in pixels of the model."""
_N_AZIMUTHS, _N_RADII = 36, 64
_NEAR, _FAR = 0.5, 2.0
"""Inner and outer end of the profiles, in radii of the crater."""
_SEARCH = 0.3
"""Half-width of the search for a crest, as a share of the radius at which the median profile is highest."""
_PLANE_FROM = 1.5
"""Inner radius of the ground to which the plane is fitted, in radii of the crater."""
_MIN_SHARE = 0.7
"""Smallest share of directions in which a crest must be found."""
_LARGEST_RMS = 0.1
"""Largest r.m.s. distance of the crest from the ellipse, in mean radii of the ellipse."""
_MIN_RATIO = 0.7
"""Smallest ratio of the ellipse's axes."""
_LARGEST_SHIFT = 0.4
"""Largest distance between the catalogued and the measured centre, in radii of the crater."""
_MIN_DEPTH = 0.02
"""Smallest depth of the centre below the crest, in diameters of the crater."""
_OUTLIER = 2.5
"""Distance from the ellipse above which a direction is excluded from the fit, in standard deviations."""
_CHUNK = 256
"""Number of craters that are measured at once."""


@dataclass(frozen=True, slots=True)
class Crests:
    """Rims of N craters in the model; NaN where no crest was found."""

    x_m: Array
    """x of the centres of the ellipses, O_L, metres (N,)."""
    y_m: Array
    """y of the centres of the ellipses, O_L, metres (N,)."""
    diameter_m: Array
    """Diameters of circles with the area of the ellipses, metres (N,)."""
    rms_share: Array
    """R.m.s. distance of the crest from the ellipse, divided by the mean radius (N,)."""
    axis_ratio: Array
    """Minor axis of the ellipse divided by the major axis (N,)."""

    @property
    def found(self) -> np.ndarray:
        """Whether a crest was found (N,)."""
        return np.isfinite(self.diameter_m)


def measure_crests(model: ElevationModel, x_m: Array, y_m: Array, diameter_m: Array) -> Crests:
    """Measure the crests of craters at positions (N,) in O_L with catalogued diameters (N,), metres."""
    measured = np.full((5, len(x_m)), np.nan)
    large = np.flatnonzero(diameter_m >= MIN_PIXELS * model.pixel_m)
    for start in range(0, len(large), _CHUNK):
        chunk = large[start : start + _CHUNK]
        radius = diameter_m[chunk] / 2
        x, y, scale = x_m[chunk], y_m[chunk], radius
        # The second pass takes centre and size from the ellipse of the first pass.
        for _ in range(2):
            fit = _fit(model, x, y, scale)
            x, y, scale = fit.x_m, fit.y_m, fit.radius_m
        shift = np.hypot(x - x_m[chunk], y - y_m[chunk]) / radius
        growth = scale / radius
        good = fit.good & (shift <= _LARGEST_SHIFT) & (growth > _NEAR) & (growth < _FAR)
        rows = np.stack([x, y, 2 * scale, fit.rms_share, fit.axis_ratio])
        measured[:, chunk] = np.where(good, rows, np.nan)
    return Crests(*measured)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Ellipses of N craters. A crater without a crest keeps its position and radius."""

    x_m: Array
    y_m: Array
    radius_m: Array
    rms_share: Array
    axis_ratio: Array
    good: np.ndarray


def _fit(model: ElevationModel, x_m: Array, y_m: Array, radius_m: Array) -> _Fit:
    angle = 2 * np.pi * np.arange(_N_AZIMUTHS) / _N_AZIMUTHS
    share = np.linspace(_NEAR, _FAR, _N_RADII)
    unit_x, unit_y = np.cos(angle)[:, None] * share, np.sin(angle)[:, None] * share
    height = _heights(model, x_m, y_m, radius_m, unit_x, unit_y)
    height -= _plane(height, unit_x, unit_y, share)
    crest, has_crest = _crest_shares(height, share)
    shape = np.stack([np.ones_like(angle), *(f(n * angle) for n in (1, 2) for f in (np.cos, np.sin))], axis=1)
    weight = has_crest.astype(float)
    for _ in range(4):
        normal = np.einsum("na,ai,aj->nij", weight, shape, shape) + 1e-9 * np.eye(5)
        terms = np.linalg.solve(normal, np.einsum("na,ai,na->ni", weight, shape, crest)[..., None])[..., 0]
        residual = np.abs(crest - terms @ shape.T)
        spread = 1.4826 * np.ma.median(np.ma.masked_array(residual, ~has_crest), axis=1).filled(np.inf)
        weight = (has_crest & (residual <= np.maximum(_OUTLIER * spread, 0.01)[:, None])).astype(float)
    n_used = weight.sum(axis=1)
    mean, swing = terms[:, 0], np.hypot(terms[:, 3], terms[:, 4])
    major, minor = np.maximum(mean + swing, 1e-3), np.maximum(mean - swing, 1e-3)
    rms = np.sqrt((weight * residual**2).sum(axis=1) / np.maximum(n_used, 1)) / np.maximum(mean, 1e-3)
    floor = _heights(model, x_m, y_m, radius_m, np.zeros((1, 1)), np.zeros((1, 1)))[:, 0, 0]
    rim = _rim_level(model, x_m, y_m, radius_m, terms @ shape.T, angle)
    good = (n_used >= _MIN_SHARE * _N_AZIMUTHS) & (rms <= _LARGEST_RMS) & (minor / major >= _MIN_RATIO)
    good &= (mean > _NEAR) & (mean < _FAR) & (rim - floor >= _MIN_DEPTH * 2 * radius_m)
    moved = good[:, None] * terms[:, 1:3] * radius_m[:, None]
    radius = np.where(good, np.sqrt(np.maximum(major * minor, 1e-6)), 1) * radius_m
    return _Fit(x_m + moved[:, 0], y_m + moved[:, 1], radius, rms, minor / major, good)


def _crest_shares(height_m: Array, share: Array) -> tuple[Array, np.ndarray]:
    """Radius (N, A) of the crest in each direction, in crater radii, and whether there is a crest (N, A).

    A crest is a maximum of the profile (N, A, R) inside a range around the highest point of the median profile; a
    maximum at the end of this range does not count.
    """
    step = share[1] - share[0]
    around = share[np.median(height_m, axis=1).argmax(axis=1)]
    inside = np.abs(share - around[:, None]) <= _SEARCH * around[:, None]
    at = np.where(inside[:, None], height_m, -np.inf).argmax(axis=2)
    first, last = inside.argmax(axis=1), inside.shape[1] - 1 - inside[:, ::-1].argmax(axis=1)
    has_crest = (at > first[:, None]) & (at < last[:, None])
    at = np.clip(at, 1, len(share) - 2)
    below, top, above = (np.take_along_axis(height_m, (at + d)[..., None], axis=2)[..., 0] for d in (-1, 0, 1))
    bend = np.minimum(below - 2 * top + above, -1e-12)
    return share[at] + step * np.clip((below - above) / (2 * bend), -0.5, 0.5), has_crest


def _plane(height_m: Array, unit_x: Array, unit_y: Array, share: Array) -> Array:
    """Heights (N, A, R) of the least-squares planes through the ground around each crater."""
    outside = share >= _PLANE_FROM
    basis = np.stack([np.ones_like(unit_x), unit_x, unit_y], axis=-1)
    solver = np.linalg.pinv(basis[:, outside].reshape(-1, 3))
    terms = height_m[:, :, outside].reshape(len(height_m), -1) @ solver.T
    return np.einsum("ni,ari->nar", terms, basis)


def _rim_level(model: ElevationModel, x_m: Array, y_m: Array, radius_m: Array, crest: Array, angle: Array) -> Array:
    """Mean height (N,) of the model along a crest (N, A) given in crater radii."""
    reach = crest * radius_m[:, None]
    return _at(model, x_m[:, None] + reach * np.cos(angle), y_m[:, None] + reach * np.sin(angle)).mean(axis=1)


def _heights(model: ElevationModel, x_m: Array, y_m: Array, radius_m: Array, unit_x: Array, unit_y: Array) -> Array:
    """Heights (N, A, R) of the model at positions around centres (N,), given in crater radii."""
    scale = radius_m[:, None, None]
    return _at(model, x_m[:, None, None] + scale * unit_x, y_m[:, None, None] + scale * unit_y)


def _at(model: ElevationModel, x_m: Array, y_m: Array) -> Array:
    """Heights of the model at positions in O_L (arrays of any shape), metres, by cubic convolution."""
    column, row = raster_places(model, x_m, y_m)
    return _cubic(model.height_m, row - 0.5, column - 0.5)


def _cubic(height_m: Array, row: Array, column: Array) -> Array:
    """Heights at fractional rows and columns (arrays of any shape), which are integers at pixel centres.

    Uses Catmull-Rom weights of 4 x 4 pixels, which need no prefilter over the whole model as a spline does.
    """
    n_rows, n_columns = height_m.shape
    row, column = np.clip(row, 0, n_rows - 1), np.clip(column, 0, n_columns - 1)
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    total = np.zeros(np.shape(row))
    for dy, by_row in zip((-1, 0, 1, 2), _weights(row - top), strict=True):
        rows = np.clip(top + dy, 0, n_rows - 1)
        for dx, by_column in zip((-1, 0, 1, 2), _weights(column - left), strict=True):
            total += by_row * by_column * height_m[rows, np.clip(left + dx, 0, n_columns - 1)]
    return total


def _weights(t: Array) -> list[Array]:
    """Weights of the four nearest pixels along an axis, for a point `t` pixels beyond the second pixel."""
    return [
        0.5 * t * (-1 + t * (2 - t)),
        1 + t * t * (-2.5 + 1.5 * t),
        0.5 * t * (1 + t * (4 - 3 * t)),
        0.5 * t * t * (t - 1),
    ]
