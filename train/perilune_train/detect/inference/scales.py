"""Detection on resized frames: enlarging brings small craters to the sizes that a network finds best."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from perilune_train.data.frames import normalised
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.batches import network_input
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3

_STEP = 32
"""Coarsest stride of the network; the sides of its input are multiples of it."""


def resized(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Resize an image (height, width); returns the same object if the size is the same."""
    if image.shape == (height_px, width_px):
        return image
    # Area averaging, when shrinking, keeps noise from aliasing into craters.
    how = cv2.INTER_AREA if width_px < image.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width_px, height_px), interpolation=how), np.uint8)


def scaled_size(height_px: int, width_px: int, factor: float) -> tuple[int, int]:
    """Height and width, pixels, nearest to `factor` times those of a frame that the network accepts."""
    if factor == 1:
        return height_px, width_px
    height, width = (max(_STEP, round(side * factor / _STEP) * _STEP) for side in (height_px, width_px))
    return height, width


def multiply_adds_of_a_frame(network: YOLOv3, config: DetectConfig, height_px: int, width_px: int) -> int:
    """Multiply-adds of the network for one frame, all scales together."""
    sizes = [scaled_size(height_px, width_px, factor) for factor in config.evaluation.scales]
    return sum(multiply_adds(network, (1, config.in_channels, *size)) for size in sizes)


@torch.no_grad()
def detect_at_scales(
    network: YOLOv3, frames: NDArray[np.uint8], config: DetectConfig, device: str, bf16: bool
) -> list[Detections]:
    """Detections of frames (N, height, width), one entry per frame, in pixels of the frames.

    The network runs once for each of `detect.evaluation.scales`; one suppression merges the detections of all scales.
    """
    height, width = frames.shape[1:]
    boxes, scores = [], []
    for factor in config.evaluation.scales:
        to_height, to_width = scaled_size(height, width, factor)
        images = np.stack([resized(frame, to_width, to_height) for frame in frames])
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            found = network.detect(network_input(normalised(images), config.in_channels).to(device))
        ratio = torch.tensor([to_width / width, to_height / height] * 2, device=device)
        boxes.append(found[0] / ratio)
        scores.append(found[1])
    return detections_of(torch.cat(boxes, 1), torch.cat(scores, 1), config.evaluation)
