"""Statistics of grey images of the Moon and of their craters. Each image is first divided by its own mean."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

FREQUENCY_EDGES = np.geomspace(0.01, 0.5, 17)
"""Edges of the bands of the power spectra, cycles per pixel."""
FREQUENCY = np.sqrt(FREQUENCY_EDGES[1:] * FREQUENCY_EDGES[:-1])
GRADIENT_EDGES = np.linspace(-3, 0.5, 71)
"""Edges of the gradient histogram: log10 of the change of brightness per pixel over the image's mean."""
BRIGHTNESS_EDGES = np.linspace(0, 3, 76)
"""Edges of the brightness histogram, in units of the image's mean."""
LEAST_POWER = 1e-9
"""Smallest power of a spectrum, since a completely black tile has none."""
DARK = 0.2
"""Pixels below this share of the mean count as shadow."""


def read_boxes(path: Path) -> Array:
    """Read crater boxes (N, 4): left, top, width, height in pixels.

    The columns are ID, X, Y, W, H, ..., separated by commas or tabs.
    """
    boxes = []
    for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1):
        fields = line.replace("\t", ",").split(",")
        if not line.strip() or fields[0].strip().upper() == "ID":
            continue
        try:
            boxes.append([float(field) for field in fields[1:5]])
            if len(boxes[-1]) < 4:
                raise ValueError
        except ValueError:
            raise UserError(path, f"line {number}", line, "ID, X, Y, W, H separated by commas or tabs") from None
    return np.array(boxes, np.float64).reshape(-1, 4)


def box_circles(boxes: Array, width_px: int, height_px: int) -> Array:
    """Centre x, y and mean of width and height (M, 3) of the boxes (N, 4) that are centred in the image."""
    x, y = boxes[:, 0] + boxes[:, 2] / 2, boxes[:, 1] + boxes[:, 3] / 2
    inside = (x >= 0) & (y >= 0) & (x < width_px) & (y < height_px)
    return np.stack([x, y, boxes[:, 2:].mean(axis=1)], axis=1)[inside]


def crater_contrast(image: np.ndarray, circles: Array) -> Array:
    """Standard deviation over mean of the brightness within each circle x, y, diameter (N, 3); NaN at the edge."""
    height, width = image.shape
    contrast = np.full(len(circles), np.nan)
    for k, (x, y, diameter) in enumerate(circles):
        left, top, n = round(x - diameter / 2), round(y - diameter / 2), max(round(diameter), 2)
        if left >= 0 and top >= 0 and left + n <= width and top + n <= height:
            axis = (np.arange(n) + 0.5) * 2 / n - 1
            inside = image[top : top + n, left : left + n][np.hypot(axis[:, None], axis) <= 1]
            contrast[k] = inside.std() / max(inside.mean(), 1e-9)
    return contrast


def cumulative_counts(diameters_px: Array, area_px: float, thresholds_px: Sequence[float]) -> Array:
    """Number per million pixels of craters of at least each threshold."""
    return (diameters_px[:, None] >= np.array(thresholds_px)).sum(axis=0) * 1e6 / area_px


def power_spectrum(image: np.ndarray, tile_px: int = 200) -> Array:
    """Radially averaged power spectral density (FREQUENCY,) of an image (h, w) divided by its mean.

    The median over Hann-windowed tiles, so that a single tile in shadow has no effect; white noise of variance v has
    the density v. Bands that contain no frequency of a tile are NaN.
    """
    relative = image / image.mean()
    window = np.outer(np.hanning(tile_px), np.hanning(tile_px))
    axis = np.fft.fftfreq(tile_px)
    band = np.digitize(np.hypot(axis[:, None], axis[None, :]).ravel(), FREQUENCY_EDGES) - 1
    used = (band >= 0) & (band < len(FREQUENCY))
    number = np.bincount(band[used], minlength=len(FREQUENCY))
    logs = []
    for top in range(0, image.shape[0] - tile_px + 1, tile_px):
        for left in range(0, image.shape[1] - tile_px + 1, tile_px):
            tile = relative[top : top + tile_px, left : left + tile_px]
            level = (tile * window).sum() / window.sum()
            power = np.abs(np.fft.fft2((tile - level) * window)).ravel() ** 2 / (window**2).sum()
            total = np.bincount(band[used], power[used], len(FREQUENCY))
            with np.errstate(invalid="ignore"):
                logs.append(np.log10(np.maximum(total / number, LEAST_POWER)))
    return 10 ** np.median(logs, axis=0)


def gradients(image: np.ndarray) -> np.ndarray:
    """Gradient magnitude (h, w) per pixel: central differences of the image divided by its mean."""
    down, right = np.gradient(image / image.mean())
    return np.hypot(down, right)


def histogram(values: np.ndarray, edges: Array) -> Array:
    """Density over the bins; values outside count in the first or last bin."""
    inside = np.clip(values.ravel(), edges[0], edges[-1])
    return np.histogram(inside, edges)[0] / (inside.size * np.diff(edges))


def summary(image: np.ndarray) -> dict[str, float]:
    """Figures of one image (h, w): brightness divided by its mean, and gradients."""
    relative = image / image.mean()
    gradient = gradients(image)
    return {
        "std": float(relative.std()),
        "skewness": float(((relative - 1) ** 3).mean() / relative.std() ** 3),
        "p1": float(np.percentile(relative, 1)),
        "p99": float(np.percentile(relative, 99)),
        "shadow_share": float((relative < DARK).mean()),
        "gradient_median": float(np.median(gradient)),
        "gradient_p99": float(np.percentile(gradient, 99)),
        "gradient_tail": float(np.percentile(gradient, 99) / max(np.median(gradient), 1e-9)),
    }


def log_difference(ours: Array, real: Array, low: float, high: float) -> Array:
    """log10 of the ratio of two spectra, for the bands between two frequencies."""
    used = np.isfinite(ours * real) & np.less_equal(low, FREQUENCY) & np.less_equal(FREQUENCY, high)
    return np.log10(ours[used] / real[used])
