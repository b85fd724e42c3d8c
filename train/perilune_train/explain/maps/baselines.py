"""Simple maps of an image that need no network: brightness, edges, local contrast, gradient."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.explain.maps.masks import Masks

Images = NDArray[np.uint8]
Map = NDArray[np.float32]
CONTRAST_WINDOW_PX = 9
"""Side of the square window of `contrast_map`, pixels."""
GRADIENT_SIGMA_PX = 2.0
"""Standard deviation of the Gaussian of `gradient_map`, pixels."""
_STAGES = 5


def brightness_map(images: Images) -> Map:
    """Brightness (N, height, width) of 8-bit images (N, height, width), 0 to 1."""
    return images.astype(np.float32) / 255


def edge_map(images: Images) -> Map:
    """Magnitude (N, height, width) of the 3 x 3 Sobel gradient of images (N, height, width)."""
    return np.stack([_magnitude(image) for image in brightness_map(images)])


def contrast_map(images: Images) -> Map:
    """Local standard deviation (N, height, width) of the brightness of images, in windows of 9 x 9 px."""
    window = (CONTRAST_WINDOW_PX, CONTRAST_WINDOW_PX)
    contrasts = []
    for image in images.astype(np.float64) / 255:
        mean, square = cv2.blur(image, window), cv2.blur(image * image, window)
        contrasts.append(np.sqrt(np.maximum(square - mean * mean, 0)))
    return np.stack(contrasts).astype(np.float32)


def gradient_map(images: Images) -> Map:
    """Magnitude (N, height, width) of the gradient of images, after smoothing by a Gaussian of 2 px.

    This map is less sensitive to sensor noise than `edge_map`.
    """
    return np.stack(
        [_magnitude(cv2.GaussianBlur(image, (0, 0), GRADIENT_SIGMA_PX)) for image in brightness_map(images)]
    )


BASELINES: dict[str, Callable[[Images], Map]] = {
    "edge": edge_map,
    "contrast": contrast_map,
    "brightness": brightness_map,
}
"""Null maps by name."""


def baseline_maps(images: Images, px_per_input_px: float = 1.0) -> Masks:
    """Every baseline of images (N, height, width) at the resolution of each stage, named "edge/stage_1" and so on.

    A smooth map correlates better with the smooth ground truth than a sharp map. For a fair comparison with masks, each
    baseline is averaged to the resolution of the stage's feature map (stride 2 to 32) and enlarged again, as masks are.
    `px_per_input_px` is the width of the images divided by the width of the network's input.
    """
    maps: Masks = {}
    for name, function in BASELINES.items():
        full = function(images)
        for stage in range(1, _STAGES + 1):
            maps[f"{name}/stage_{stage}"] = np.stack(
                [_at_stride(full_map, 2**stage * px_per_input_px) for full_map in full]
            )
    return maps


def _at_stride(map_: Map, stride_px: float) -> Map:
    height, width = map_.shape
    size = max(1, round(width / stride_px)), max(1, round(height / stride_px))
    small = cv2.resize(map_, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height)), np.float32)


def _magnitude(image: NDArray[np.floating]) -> Map:
    across, down = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    return np.asarray(np.hypot(across, down), np.float32)
