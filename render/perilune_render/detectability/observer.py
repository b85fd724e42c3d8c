"""Detectability d' of a crater in sensor noise and in the clutter of the ground at its place.

The observer knows where the crater is, how large it is and where the Sun stands, but not its exact image. It has one
channel: the shading t of a bowl that is lit from one side, -s exp(-(r / 0.8)^4) within REACH radii, with r the distance
from the centre and s the offset towards the Sun, both in radii. The part of t that a plane explains is removed. The
response to an image g is t . g. With the change of the expected image by the crater as the signal,

    d' = (t . signal) / (|t| sigma) sqrt(min(1, MAX_PIXELS / n)),    sigma^2 = clutter^2 + noise^2.

`noise` is the standard deviation of the sensor noise. `clutter` is the standard deviation of the expected image without
the crater within the same n pixels, after a plane is subtracted: the relief, boulders and other craters at this place,
under this Sun. Neighbouring pixels of clutter are alike, so at most MAX_PIXELS pixels count as independent.

This observer was chosen among others because its d' predicts best what a detector finds (docs/explanation/labels.md).
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.labels.pixels import REACH
from perilune_shared.geometry.frames import Array

MAX_PIXELS = 250.0
"""Largest number of pixels that count as independent; the same as in the selection `visible`."""
_N_PLANE = 3


@dataclass(frozen=True, slots=True)
class Observation:
    """Detectability of one crater in one frame, and its parts."""

    d_prime: float
    """Distance between the observer's mean responses with and without the crater, in standard deviations of the
    response. Negative if the crater looks like a bump, 0 if too few pixels are in the image."""
    signal_energy: float
    """Sum of the squared change of the expected image by the crater, DN^2."""
    clutter_sigma: float
    """Standard deviation of the expected image without the crater, at its place, DN."""
    noise_sigma: float
    """Standard deviation of the sensor noise at the crater, DN."""


def observe(
    signal: np.ndarray, background: np.ndarray, noise: np.ndarray, centre_px: tuple[float, float], axes_px: Array
) -> Observation:
    """The detectability of a crater.

    `signal` (h, w) is the change of the expected image by the crater, `background` (h, w) the expected image without
    it, `noise` (h, w) the standard deviation of the sensor noise, all in DN. `centre_px` are x and y of the crater's
    centre in these arrays. `axes_px` (2, 2) maps offsets in the plane of the rim, in radii along and across the
    direction of the Sun, to offsets in pixels (x, y).
    """
    energy = float(np.square(signal, dtype=np.float64).sum())
    along, across, rows, columns = _offsets(signal.shape, centre_px, axes_px)
    square = along**2 + across**2
    inside = square <= REACH**2
    n = int(inside.sum())
    if n <= _N_PLANE + 1:
        return Observation(0.0, energy, 0.0, 0.0)
    s, t, square = along[inside], across[inside], square[inside]
    pixels = [image[rows, columns][inside].astype(np.float64) for image in (signal, background, noise)]
    plane, _ = np.linalg.qr(np.stack([np.ones(n), s, t], axis=1))
    shading = -s * np.exp(-np.square(square / 0.64))
    shading, rest = (values - plane @ (plane.T @ values) for values in (shading, pixels[1]))
    length = np.sqrt(shading @ shading)
    clutter = rest @ rest / (n - _N_PLANE)
    variance = np.square(pixels[2]).mean()
    response = shading @ pixels[0] / length if length > 1e-9 else 0.0
    d_prime = response * np.sqrt(min(1.0, MAX_PIXELS / n) / (clutter + variance))
    return Observation(float(d_prime), energy, float(np.sqrt(clutter)), float(np.sqrt(variance)))


def _offsets(
    shape: tuple[int, ...], centre_px: tuple[float, float], axes_px: Array
) -> tuple[Array, Array, slice, slice]:
    """Offsets of pixels from the centre along and across the Sun, in radii, and the rows and columns of the pixels.

    The pixels fill the box around the disc of REACH radii.
    """
    half = REACH * np.hypot(axes_px[:, 0], axes_px[:, 1])
    limits = []
    for centre, reach, size in zip(centre_px, half, reversed(shape), strict=True):
        start = min(max(int(np.floor(centre - reach)), 0), size)
        limits.append(slice(start, max(min(int(np.ceil(centre + reach)), size), start)))
    columns, rows = limits
    y, x = np.mgrid[rows, columns] + 0.5
    along, across = np.linalg.solve(axes_px, np.stack([(x - centre_px[0]).ravel(), (y - centre_px[1]).ravel()]))
    return along.reshape(x.shape), across.reshape(x.shape), rows, columns
