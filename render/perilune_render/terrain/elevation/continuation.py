"""Smooth continuation of the ground beyond the edge of an elevation model.

Each scale of the model's relief continues by point reflection, which keeps height and slope at the edge. The reflection
fades within about a third of the wavelength, so that the model's features do not repeat. The model's mean slope fades
over a distance equal to the model's size. The result is smooth; `perilune_render.terrain.elevation.surroundings` adds
relief and craters at each scale where the model's relief fades.
"""

import numpy as np
from scipy import fft, ndimage

from perilune_shared.geometry.frames import Array

_COARSEST = 1 / 8
"""Standard deviation of the widest low-pass filter, relative to the model's shorter side."""
_FADE = 1.5
"""Distance over which a wavelength band fades, in standard deviations of its low-pass filter."""
_WAVES = 5.0
"""Main wavelength of a band, in standard deviations of its low-pass filter."""
_GONE = 2.5
"""Distance at which a band counts as faded out, in fade distances."""


def margin_m(sides_m: tuple[float, float]) -> float:
    """Distance beyond which only the mean slope of a model with these sides remains, metres."""
    return _GONE * _FADE * _COARSEST * min(sides_m)


def fade(distance_m: Array, wavelength_m: float) -> Array:
    """Share of the model's relief of one wavelength L that remains at distances d from the model.

    The share is exp(-(d / (0.3 L))^2), with slope 0 at the edge. Both arguments are in metres.
    """
    return np.exp(-((distance_m * _WAVES / (_FADE * wavelength_m)) ** 2))


def continued(height_m: Array, beyond_m: Array, margin: int, pixel_m: tuple[float, float]) -> Array:
    """Heights (rows, columns) minus their `plane`, extended by `margin` pixels on each side.

    beyond_m (rows + 2 margin, columns + 2 margin) is the distance from known ground, metres; where it is 0, the heights
    do not fade. pixel_m is the pixel size between rows and between columns, metres.
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
    """Heights, at rows and columns, of the least-squares plane through heights (rows, columns).

    Row and column are 0 at the centre of the first pixel.
    """
    n_rows, n_columns = height_m.shape
    i, j = np.arange(n_rows) - (n_rows - 1) / 2, np.arange(n_columns) - (n_columns - 1) / 2
    mean = height_m.mean()
    by_row = (i @ (height_m - mean)).sum() / max(n_columns * (i @ i), 1e-9)
    by_column = ((height_m - mean) @ j).sum() / max(n_rows * (j @ j), 1e-9)
    return mean + by_row * (row - (n_rows - 1) / 2) + by_column * (column - (n_columns - 1) / 2)


def mean_slope(height_m: Array, row: Array, column: Array, beyond_m: Array, side_m: float) -> Array:
    """The mean height plus the model's mean slope (`plane`), metres; beyond the model, the slope fades.

    The slope fades as 1 / (1 + (d / side)^2), where `side_m` is the model's shorter side.
    """
    mean = height_m.mean()
    return mean + (plane(height_m, row, column) - mean) / (1 + (beyond_m / side_m) ** 2)


def distance_in_holes_m(known: np.ndarray, pixel_m: tuple[float, float]) -> Array | None:
    """Distance of each pixel (rows, columns) from the nearest known pixel, metres; None without holes."""
    return None if known.all() else ndimage.distance_transform_edt(~known, sampling=pixel_m)
