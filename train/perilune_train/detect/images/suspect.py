"""Find pictures that are not regolith seen by a camera at a usable scale.

The checks are statistics of the grey levels and, with ten craters or more, of the detections: in a picture of the Moon
the Sun lights all craters from the same side (one_light.py), and most reported craters are probable. Each limit lies
outside the range of rendered frames with Suns of 2 to 65 degrees and with other contrast, blur and noise; the page
docs/notebook/2026-11-28-scores.md has the measurement. Ground of other bodies, and textures that one lamp lights from
the side, can pass.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.images.one_light import MIN_CRATERS, agreement_of_light

MIN_DEVIATION = 4.0
"""Smallest standard deviation of the grey levels, of 0 to 255."""
MAX_WHITE, MAX_DARK, MAX_FLAT = 0.5, 0.9, 0.2
"""Largest shares: of pixels above 253; of pixels below 15 % of the brightest; of blocks with one grey level."""
MAX_NOISE, MIN_NOISE = 0.45, 0.013
"""Range of the noise, in standard deviations of the grey levels: white noise has 1, a smooth gradient almost 0."""
MAX_STRAIGHT = 0.15
"""Largest share of the strong gradients in one of 36 directions."""
MIN_SLOPE = -2.9
"""Smallest slope of the power spectrum: power is proportional to frequency^slope."""
MIN_LIGHT, MIN_LIGHT_UNCALIBRATED = 2.25, 1.9
"""Smallest sum of the agreement of the light and twice the median score of the craters, with scores that are
probabilities and with scores without calibration."""
_TILE_PX, _MAX_TILES, _MIN_SIDE_PX = 256, 4, 128
_BLOCK_PX, _BLACK = 8, 8
_BANDS = np.geomspace(1 / 64, 0.45, 9)


@dataclass(frozen=True)
class Suspicion:
    """Why a picture may not show regolith at a usable scale."""

    reason: str
    """Value of the column `suspect`: blank, overexposed, dark, flat, noise, smooth, straight or light."""
    text: str
    """The measured statistic and its limit, in one line."""


def suspicion_of(image: NDArray[np.uint8], detections: Detections, calibrated: bool) -> Suspicion | None:
    """Check a grey image (height, width) and all its detections; returns None if nothing is suspicious.

    `calibrated` states whether the scores are probabilities.
    """
    deviation, white, dark = _grey_levels(image)
    if deviation < MIN_DEVIATION:
        return _above("blank", "standard deviation of the grey levels", deviation, MIN_DEVIATION)
    if white > MAX_WHITE:
        return _below("overexposed", "share of white pixels", white, MAX_WHITE)
    if dark > MAX_DARK:
        return _below("dark", "share of pixels below 15 % of the brightest", dark, MAX_DARK)
    looks = [_look(tile) for tile in tiles_of(image)]
    if looks:
        flat, noise, straight, slope = np.median(looks, axis=0).tolist()
        if flat > MAX_FLAT:
            return _below("flat", "share of areas of one grey level", flat, MAX_FLAT)
        if noise > MAX_NOISE:
            return _below("noise", "noise relative to the contrast", noise, MAX_NOISE)
        if noise < MIN_NOISE:
            return _above("smooth", "fine detail relative to the contrast", noise, MIN_NOISE)
        if slope < MIN_SLOPE:
            return _above("smooth", "slope of the power spectrum", slope, MIN_SLOPE)
        if straight > MAX_STRAIGHT:
            return _below("straight", "share of the strong edges in one direction", straight, MAX_STRAIGHT)
    agreement, median, count = agreement_of_light(image, detections)
    total, limit = agreement + 2 * median, MIN_LIGHT if calibrated else MIN_LIGHT_UNCALIBRATED
    if count >= MIN_CRATERS and total < limit:
        what = f"agreement of the light on {count} craters ({agreement:.2f}) plus twice their median score"
        return _above("light", what, total, limit)
    return None


def _grey_levels(image: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Standard deviation, share of white pixels and share of dark pixels, from the histogram: images can be large."""
    share = cv2.calcHist([image], [0], None, [256], [0, 256]).ravel().astype(np.float64) / image.size
    levels = np.arange(256)
    deviation = np.sqrt(max(share @ levels**2 - (share @ levels) ** 2, 0.0))
    brightest = np.searchsorted(np.cumsum(share), 0.999)
    return float(deviation), float(share[254:].sum()), float(share[levels <= 0.15 * brightest].sum())


def tiles_of(image: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """At most 16 square tiles, evenly spaced, without blank ones; none if the image is smaller than 128 px."""
    side = min(*image.shape, _TILE_PX)
    if side < _MIN_SIDE_PX:
        return []
    starts = [
        np.unique(np.linspace(0, length - side, min(_MAX_TILES, -(-length // side))).astype(int)).tolist()
        for length in image.shape
    ]
    tiles = [image[top : top + side, left : left + side] for top in starts[0] for left in starts[1]]
    return [tile for tile in tiles if tile.std() >= 1]


def _look(tile: NDArray[np.uint8]) -> tuple[float, float, float, float]:
    """Flat share, noise, share of the most frequent direction of edges, and slope of the spectrum, of a square tile."""
    grey, side = tile.astype(np.float64), len(tile)
    count = side // _BLOCK_PX
    blocks = tile[: count * _BLOCK_PX, : count * _BLOCK_PX].reshape(count, _BLOCK_PX, count, _BLOCK_PX)
    lit = blocks.mean((1, 3)) > _BLACK
    flat = float((blocks.max((1, 3)) == blocks.min((1, 3)))[lit].mean()) if lit.any() else 0.0
    # Immerkaer, 1996, "Fast Noise Variance Estimation".
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float64)
    noise = np.sqrt(np.pi / 2) * np.abs(cv2.filter2D(grey, -1, mask)[1:-1, 1:-1]).mean() / 6 / grey.std()
    return flat, float(noise), _straightness(grey), _spectrum_slope(grey)


def _straightness(grey: NDArray[np.float64]) -> float:
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    along_x, along_y = cv2.Sobel(smooth, -1, 1, 0), cv2.Sobel(smooth, -1, 0, 1)
    length = np.hypot(along_x, along_y)
    strong = length >= max(float(np.quantile(length, 0.9)), 1e-9)
    direction = np.arctan2(along_y[strong], along_x[strong]) % np.pi
    counts, _ = np.histogram(direction, 36, (0, np.pi), weights=length[strong])
    return float(counts.max() / max(counts.sum(), 1e-9))


def _spectrum_slope(grey: NDArray[np.float64]) -> float:
    side = len(grey)
    window = np.hanning(side)
    power = np.abs(np.fft.rfft2((grey - grey.mean()) * window * window[:, None])) ** 2
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    band = np.searchsorted(_BANDS, frequency)
    levels = [np.log(power[band == k].mean() + 1e-6) for k in range(1, len(_BANDS))]
    return float(np.polyfit(np.log(np.sqrt(_BANDS[:-1] * _BANDS[1:])), levels, 1)[0])


def _above(reason: str, what: str, got: float, limit: float) -> Suspicion:
    return Suspicion(reason, f"{what}: got {got:.3g}, expected at least {limit:g}; is it a picture of the Moon?")


def _below(reason: str, what: str, got: float, limit: float) -> Suspicion:
    return Suspicion(reason, f"{what}: got {got:.3g}, expected at most {limit:g}; is it a picture of the Moon?")
