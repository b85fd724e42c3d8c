"""Detectability d' of a known signal in sensor noise and in the local clutter of its frame.

The prewhitening observer knows the signal s and the power spectrum of what hides it. Its d' is

    d'^2 = sum over frequencies f of |S(f)|^2 / (C(f) + N),

with S the unitary Fourier transform of s, C the power spectrum of the clutter and N the variance of the sensor noise,
which is white. C is the power of the frame itself around the crater, but without the crater: a tapered window of
CLUTTER_RADII radii, minus a fitted plane, averaged over all directions. Clutter of other ground and other light
therefore has no effect. Without clutter, d' is the norm of s divided by the standard deviation of the noise.
"""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.frames import Array

CLUTTER_RADII = 2.0
"""Half-width of the window in which clutter is measured, in radii of the crater."""
MIN_HALF_PX = 6.0
"""Smallest half-width of this window, pixels."""


@dataclass(frozen=True, slots=True)
class Observation:
    """Detectability of one crater in one frame, and its parts."""

    d_prime: float
    """Distance of the means of the observer's response with and without the crater, in standard deviations."""
    signal_energy: float
    """Sum of the squared change of the expected image by the crater, DN^2."""
    clutter_sigma: float
    """Standard deviation of the clutter around the crater, DN."""
    noise_sigma: float
    """Standard deviation of the sensor noise around the crater, DN."""


def observe(
    signal: np.ndarray, background: np.ndarray, noise: np.ndarray, centre_px: tuple[float, float], radius_px: float
) -> Observation:
    """The detectability of a crater with a known signal.

    `signal` (H, W) is the change of the expected image by the crater, `background` (H, W) the expected image without
    it, `noise` (H, W) the standard deviation of the sensor noise; all in DN. `centre_px` are x and y of the crater's
    centre, `radius_px` is its radius. The part of the signal outside the window of the clutter is ignored.
    """
    window = _window(signal.shape, centre_px, max(CLUTTER_RADII * radius_px, MIN_HALF_PX))
    s = signal[window].astype(np.float64)
    clutter = clutter_power(background[window].astype(np.float64))
    variance = float(np.square(noise[window], dtype=np.float64).mean())
    power = np.square(np.abs(np.fft.fft2(s))) / s.size
    return Observation(
        float(np.sqrt((power / (clutter + variance)).sum())),
        float(np.square(signal, dtype=np.float64).sum()),
        float(np.sqrt(clutter.mean())),
        float(np.sqrt(variance)),
    )


def _window(shape: tuple[int, ...], centre_px: tuple[float, float], half_px: float) -> tuple[slice, slice]:
    """Rows and columns of a square window, moved inwards or cut off at the edge of the image."""
    slices = []
    for centre, size in zip(reversed(centre_px), shape, strict=True):
        start, stop = int(np.floor(centre - half_px)), int(np.ceil(centre + half_px))
        least = min(int(2 * MIN_HALF_PX), size)
        start = min(max(start, 0), size - least)
        slices.append(slice(start, max(min(stop, size), start + least)))
    return slices[0], slices[1]


def clutter_power(patch: Array) -> Array:
    """Power spectrum (h, w) of a patch of background (h, w), DN^2, in the order of `numpy.fft.fft2`.

    A plane is subtracted and the patch is tapered by a Hann window. The power is averaged over all directions, in rings
    that are a frequency step of the window's shorter side wide. The mean over all frequencies is the variance.
    """
    height, width = patch.shape
    taper = np.outer(_hann(height), _hann(width))
    y, x = np.mgrid[0:height, 0:width]
    terms = np.stack([np.ones(patch.size), y.ravel() - y.mean(), x.ravel() - x.mean()], axis=1)
    weight = taper.ravel()[:, None]
    fitted = np.linalg.lstsq(terms * weight, patch.ravel() * weight[:, 0], rcond=None)[0]
    rest = (patch.ravel() - terms @ fitted).reshape(patch.shape) * taper
    power = np.square(np.abs(np.fft.fft2(rest))) / np.square(taper).sum()
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None])
    n_rings = min(height, width) // 2
    ring = np.minimum((frequency * 2 * n_rings).astype(int), n_rings)
    mean = np.bincount(ring.ravel(), power.ravel()) / np.maximum(np.bincount(ring.ravel()), 1)
    # The plane has removed the power at frequency 0.
    mean[0] = max(mean[0], mean[1])
    return mean[ring]


def _hann(n: int) -> Array:
    return np.hanning(n + 2)[1:-1]
