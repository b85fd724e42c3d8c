"""Random augmentation of training frames and their outlines.

An outline is a box x0, y0, x1, y1 in pixels and the correlation of the ellipse in it (detect/ellipses.py).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.config import AugmentSettings
from perilune_train.detect.data.ignored import MARGIN

Array = NDArray[np.float64]
_LEVELS = 12, 64
"""Smallest and largest number of grey levels of a reduced frame."""
_QUALITY = 30, 95
"""Lowest and highest quality of a compressed frame."""


def turn(image: NDArray, outlines: Array, kind: int) -> tuple[NDArray, Array]:
    """Apply one of the eight symmetries to a frame (height, width) and its outlines (M, 5).

    Bit 0 of `kind` mirrors left and right, bit 1 top and bottom, bit 2 (applied last) exchanges x and y.
    """
    height, width = image.shape
    x0, y0, x1, y1, correlation = outlines.T
    if kind & 1:
        image, x0, x1, correlation = image[:, ::-1], width - x1, width - x0, -correlation
    if kind & 2:
        image, y0, y1, correlation = image[::-1], height - y1, height - y0, -correlation
    if kind & 4:
        image, x0, y0, x1, y1 = image.T, y0, x0, y1, x1
    return image, np.stack([x0, y0, x1, y1, correlation], axis=1)


def rescale(image: NDArray, outlines: Array, factor: float, offset: tuple[float, float]) -> tuple[NDArray, Array]:
    """Enlarge or shrink a frame (height, width) and its outlines (M, 5); the image size is kept.

    `offset` (x and y, each 0 to 1) selects which part of an enlarged frame is kept, or where a shrunk frame is placed.
    A shrunk frame is surrounded by its mean grey.
    """
    height, width = image.shape
    shift = np.array([width, height]) * (1 - 1 / factor) * np.array(offset)
    if factor < 1:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(1 / factor**2 - 1))
    # OpenCV's coordinates are 0 at the centre of the first pixel, box coordinates at its outer corner.
    origin = shift + 0.5 / factor - 0.5
    matrix = np.array([[1 / factor, 0, origin[0]], [0, 1 / factor, origin[1]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    scaled = cv2.warpAffine(image, matrix, (width, height), flags=flags, borderValue=float(image.mean()))
    return scaled, np.column_stack([(outlines[:, :4] - np.tile(shift, 2)) * factor, outlines[:, 4:]])


def grey_levels(image: NDArray[np.uint8], settings: AugmentSettings, rng: np.random.Generator) -> NDArray[np.float32]:
    """Values (256,) of a frame's grey levels after a random stretch, gamma and gain; at most 255."""
    level = np.arange(256) / 255
    if settings.stretch:
        below = np.bincount(image.ravel(), minlength=256).cumsum() / image.size
        black, white = np.searchsorted(below, [rng.uniform(0, settings.stretch), 1 - rng.uniform(0, settings.stretch)])
        level = np.clip((np.arange(256) - black) / max(white - black, 1), 0, 1)
    gain = np.exp(rng.uniform(-1, 1) * np.log1p(settings.gain))
    gamma = np.exp(rng.uniform(-1, 1) * settings.gamma)
    return (255 * np.minimum(gain * level**gamma, 1)).astype(np.float32)


def augment(
    image: NDArray[np.uint8],
    outlines: Array,
    selected: NDArray[np.bool_],
    radius_px: tuple[float, float],
    settings: AugmentSettings,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_]]:
    """Augment a frame and its outlines (M, 5) at random.

    Returns grey levels (height, width) float32, outlines (M, 5), and whether each crater is selected (M,). A crater is
    deselected if rescaling moves its radius out of the range `radius_px` or its centre off the image. It is removed if
    it becomes much smaller than that range or leaves the image.
    """
    turned: NDArray = image
    if settings.flips_and_turns:
        square = image.shape[0] == image.shape[1]
        turned, outlines = turn(image, outlines, int(rng.integers(8 if square else 4)))
    low, high = settings.scale
    if (low, high) != (1, 1):
        factor = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        turned, outlines = rescale(np.ascontiguousarray(turned), outlines, factor, (rng.random(), rng.random()))
        size, boxes = np.array(turned.shape[::-1]), outlines[:, :4]
        centre, radius = (boxes[:, :2] + boxes[:, 2:]) / 2, np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(1)) / 2
        seen = ((boxes[:, 2:] > 0) & (boxes[:, :2] < size)).all(1) & (radius >= radius_px[0] * MARGIN)
        outlines, selected, centre, radius = outlines[seen], selected[seen], centre[seen], radius[seen]
        inside = ((centre >= 0) & (centre < size)).all(1)
        selected = selected & inside & (radius >= radius_px[0]) & (radius <= radius_px[1])
    pixels = grey_levels(turned, settings, rng)[turned]
    sigma_px = rng.uniform(0, settings.blur_px)
    if sigma_px > 0.3:
        pixels = cv2.GaussianBlur(pixels, (0, 0), sigma_px).astype(np.float32, copy=False)
    noise = rng.uniform(0, settings.noise)
    if noise > 0:
        pixels = pixels + np.float32(noise) * rng.standard_normal(pixels.shape, np.float32)
    return stored(pixels, settings, rng), outlines, selected


def stored(pixels: NDArray[np.float32], settings: AugmentSettings, rng: np.random.Generator) -> NDArray[np.float32]:
    """Grey levels (height, width) after the losses of files: fewer grey levels, and compression by JPEG."""
    # Draw numbers only for effects that are used, so that other settings give the same frames as before.
    if settings.levels and rng.random() < settings.levels:
        step = 255 / (np.round(np.exp(rng.uniform(*np.log(_LEVELS)))) - 1)
        pixels = (np.rint(np.clip(pixels, 0, 255) / step) * step).astype(np.float32)
    if settings.jpeg and rng.random() < settings.jpeg:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(_QUALITY[0], _QUALITY[1] + 1))]
        _, content = cv2.imencode(".jpg", np.clip(np.rint(pixels), 0, 255).astype(np.uint8), quality)
        pixels = np.asarray(cv2.imdecode(content, cv2.IMREAD_GRAYSCALE), np.float32)
    return pixels
