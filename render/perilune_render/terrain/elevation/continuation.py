"""Ground beyond the edge of an elevation model: level and slope continue and fade.

Each scale of the model's relief is continued by point reflection, which keeps level and slope, and fades within about a
third of its own wavelength, so that nothing of the model is repeated; its mean slope fades over the model's own
size. What is left is smooth: `perilune_render.terrain.elevation.surroundings` adds relief and craters as each scale
fades.
"""

import numpy as np
from scipy import fft, ndimage

from perilune_shared.geometry.frames import Array

_COARSEST = 1 / 8
"""Standard deviation of the widest low-pass over the model's shorter side."""
_FADE = 1.5
"""Distance over which a band fades, over the standard deviation of its low-pass."""
_WAVES = 5.0
"""Wavelength of most of a band over the standard deviation of its low-pass."""
_GONE = 2.5
"""Fade distances at which a band is taken as gone."""


def margin_m(sides_m: tuple[float, float]) -> float:
    """Distance in metres from a model of these sides at which only its mean slope is left."""
    return _GONE * _FADE * _COARSEST * min(sides_m)


def fade(distance_m: Array, wavelength_m: float) -> Array:
    """Share of the model's relief of one wavelength that is left at distances (...) from its known ground.

    exp(-(d / 0.3 L)^2), without slope at the edge.
    """
    return np.exp(-((distance_m * _WAVES / (_FADE * wavelength_m)) ** 2))


def continued(height_m: Array, beyond_m: Array, margin: int, pixel_m: tuple[float, float]) -> Array:
    """Heights (rows, columns) with `margin` more pixels on each side, less their mean slope (`mean_slope`).

    beyond_m (rows + 2 margin, columns + 2 margin) is the distance from known ground; where it is 0 nothing changes.
    pixel_m is the size of a pixel along rows and columns, metres.
    """
    row, column = (np.arange(n, dtype=np.float64) for n in height_m.shape)
    rest = height_m - plane(height_m, row[:, None], column)
    rest = np.pad(rest, margin, mode="reflect", reflect_type="odd") if margin else rest
    frequency = [np.pi * np.arange(n) / n / m for n, m in zip(rest.shape, pixel_m, strict=True)]
    square = frequency[0][:, None] ** 2 + frequency[1] ** 2
    spectrum = fft.dctn(rest)
    widest = _COARSEST * min(n * m for n, m in zip(height_m.shape, pixel_m, strict=True))
    sigma, total = max(pixel_m), np.zeros_like(rest)
    while sigma < widest:
        smooth = fft.idctn(spectrum * np.exp(-square * sigma**2 / 2))
        total += (rest - smooth) * fade(beyond_m, _WAVES * sigma)
        rest, sigma = smooth, 2 * sigma
    total += rest * fade(beyond_m, _WAVES * max(widest, sigma / 2))
    return total


def plane(height_m: Array, row: Array, column: Array) -> Array:
    """The least-squares plane through heights (rows, columns), at places counted from the first pixel's centre."""
    n_rows, n_columns = height_m.shape
    i, j = np.arange(n_rows) - (n_rows - 1) / 2, np.arange(n_columns) - (n_columns - 1) / 2
    mean = height_m.mean()
    by_row = (i @ (height_m - mean)).sum() / max(n_columns * (i @ i), 1e-9)
    by_column = ((height_m - mean) @ j).sum() / max(n_rows * (j @ j), 1e-9)
    return mean + by_row * (row - (n_rows - 1) / 2) + by_column * (column - (n_columns - 1) / 2)


def mean_slope(height_m: Array, row: Array, column: Array, beyond_m: Array, side_m: float) -> Array:
    """`plane`, whose departure from the mean fades beyond the model.

    It fades as 1 / (1 + (d / side)^2), `side_m` being the model's shorter side.
    """
    mean = height_m.mean()
    return mean + (plane(height_m, row, column) - mean) / (1 + (beyond_m / side_m) ** 2)


def distance_in_holes_m(known: np.ndarray, pixel_m: tuple[float, float]) -> Array | None:
    """Distance in metres of each pixel (rows, columns) from the nearest known one; None where all are known."""
    return None if known.all() else ndimage.distance_transform_edt(~known, sampling=pixel_m)
