"""Local contrast of frames, image pyramids, and bilinear sampling."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

_FINE_PX, _COARSE_PX = 0.5, 2.0
"""Standard deviations of the fine and the coarse blur, pixels. Chosen on training and validation scenes."""
_MIN_BACKGROUND = 2.0
"""Grey value that is added to the background, so that the contrast in black shadow stays finite."""


@dataclass(frozen=True, slots=True)
class Level:
    """One level of a pyramid."""

    camera: Camera
    """Intrinsics of this level."""
    contrast: Any
    """Local contrast (height, width), or what another function computed from the image (see `pyramid`)."""


def local_contrast(image: np.ndarray, fine_px: float = _FINE_PX, coarse_px: float = _COARSE_PX) -> Array:
    """Contrast (height, width) of an 8-bit image with its surroundings: (G_fine - G_coarse) / G_coarse.

    `fine_px` and `coarse_px` are the standard deviations of the two blurs, pixels. A brightness factor that varies
    slowly, over many pixels, does not change this contrast. Aligning grey values instead gave errors of metres
    (docs/notebook/2026-11-23-alignment.md).
    """
    grey = image.astype(np.float32)
    fine, coarse = (
        cv2.GaussianBlur(grey, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT) for sigma_px in (fine_px, coarse_px)
    )
    return (fine - coarse) / (coarse + _MIN_BACKGROUND)


def pyramid(
    image: np.ndarray, camera: Camera, n_levels: int, contrast: Callable[[np.ndarray], Any] = local_contrast
) -> list[Level]:
    """Levels of an image, coarsest first. Each is half as large as the next one, reduced by area averaging.

    `contrast` computes what a level stores from its 8-bit image.
    """
    levels = []
    for number in range(n_levels):
        if number:
            height, width = image.shape[0] // 2, image.shape[1] // 2
            across, down = width / image.shape[1], height / image.shape[0]
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            camera = Camera(
                width, height, camera.fx_px * across, camera.fy_px * down, camera.cx_px * across, camera.cy_px * down
            )
        levels.append(Level(camera, contrast(image)))
    return levels[::-1]


def sampled(values: Array, pixels: Array) -> Array:
    """Interpolate maps (k, height, width) bilinearly at image coordinates (n, 2); returns (k, n), NaN outside.

    OpenCV's `remap` is not used, because it rounds coordinates to 1/32 px.
    """
    height, width = values.shape[1:]
    x, y = pixels[:, 0] - 0.5, pixels[:, 1] - 0.5
    inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    column, row = x.astype(np.intp), y.astype(np.intp)
    right, down = (x - column).astype(np.float32), (y - row).astype(np.float32)
    flat, first = values.reshape(len(values), -1), row * width + column
    upper = flat[:, first] * (1 - right) + flat[:, first + 1] * right
    lower = flat[:, first + width] * (1 - right) + flat[:, first + width + 1] * right
    return np.where(inside, upper * (1 - down) + lower * down, np.nan)
