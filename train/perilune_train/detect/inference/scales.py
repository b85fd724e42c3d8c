"""Detection on resized frames: enlargement brings small craters to sizes that a network detects better."""

import time
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from perilune_shared.console.terminal import progress_bar
from perilune_train.detect.config import COARSEST_STRIDE, DetectConfig
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.inference.suppression import detections_of
from perilune_train.models.ellipse import resized_shapes
from perilune_train.models.size import multiply_adds
from perilune_train.models.yolo import YOLOv3

_REACH = 4
"""Number of pixels beyond a slice that cubic interpolation needs."""


def resized(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Resize an image (height, width); returns the input itself if the size is right already."""
    if image.shape == (height_px, width_px):
        return image
    # When an image is shrunk, area averaging avoids aliased noise, which looks like craters.
    interpolation = cv2.INTER_AREA if width_px < image.shape[1] else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width_px, height_px), interpolation=interpolation), np.uint8)


class Enlarged:
    """An enlarged view of an image (height, width) that computes only the pixels of the requested slice.

    Use it for images that do not fit into memory when enlarged. The values differ slightly from those of `resized`,
    because OpenCV interpolates here at only 32 positions between two pixels.
    """

    def __init__(self, image: NDArray[np.uint8], width_px: int, height_px: int):
        self._image, self.shape = image, (height_px, width_px)
        self._ratio = image.shape[0] / height_px, image.shape[1] / width_px

    def __getitem__(self, slices: tuple[slice, slice]) -> NDArray[np.uint8]:
        starts, sizes, lows, parts = [], [], [], []
        for part, length, ratio, side in zip(slices, self.shape, self._ratio, self._image.shape, strict=True):
            start, stop, _ = part.indices(length)
            low, high = (int(np.floor(edge * ratio)) + more for edge, more in ((start, -_REACH), (stop, _REACH + 1)))
            starts.append((start + 0.5) * ratio - 0.5 - max(low, 0))
            sizes.append(stop - start)
            lows.append(max(low, 0))
            parts.append(slice(max(low, 0), min(high, side)))
        matrix = np.array([[self._ratio[1], 0, starts[1]], [0, self._ratio[0], starts[0]]])
        source = np.ascontiguousarray(self._image[parts[0], parts[1]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        window = cv2.warpAffine(source, matrix, (sizes[1], sizes[0]), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(window, np.uint8)


def scaled_size(height_px: int, width_px: int, factor: float) -> tuple[int, int]:
    """Height and width, pixels, nearest to `factor` times the frame's, that the network accepts."""
    if factor == 1:
        return height_px, width_px
    height, width = (max(1, round(side * factor / COARSEST_STRIDE)) for side in (height_px, width_px))
    return COARSEST_STRIDE * height, COARSEST_STRIDE * width


def multiply_adds_of_a_frame(network: YOLOv3, config: DetectConfig, height_px: int, width_px: int) -> int:
    """Multiply-adds of the network for one frame, summed over all scales."""
    sizes = [scaled_size(height_px, width_px, factor) for factor in config.evaluation.scales]
    return sum(multiply_adds(network, (1, config.in_channels, *size)) for size in sizes)


def detect_at_scales(detector: Detector, frames: NDArray[np.uint8]) -> list[Detections]:
    """Detections of frames (N, height, width), one entry per frame, in pixels of the frames.

    The network runs once for each of `detect.evaluation.scales`; one suppression merges the detections of all scales.
    Small boxes of reduced frames are dropped (`detect.evaluation.min_coarse_radius_px`). Novelty is known if the
    detector has training features and scale 1 is among the scales.
    """
    height, width = frames.shape[1:]
    settings = detector.config.evaluation
    boxes, scores, shapes, novelty = [], [], [], None
    for factor in settings.scales:
        to_height, to_width = scaled_size(height, width, factor)
        inputs = np.stack([resized(frame, to_width, to_height) for frame in frames])
        if factor == 1:
            found, confidence, shape, novelty = detector.predict_with_novelty(inputs)
        else:
            found, confidence, shape = detector.predict(inputs)
        ratios = torch.tensor([to_width / width, to_height / height], device=detector.device)
        boxes.append(found / ratios.repeat(2))
        if factor < min(1.0, max(settings.scales)):
            radius_px = (found[..., 2:] - found[..., :2]).clamp(min=0).prod(-1).sqrt() / 2
            confidence = confidence * (radius_px >= settings.min_coarse_radius_px)
        scores.append(confidence)
        if shape is not None:
            shapes.append(shape if factor == 1 else resized_shapes(shape, found, boxes[-1], ratios))
    every_shape = torch.cat(shapes, 1) if shapes else None
    merged = detections_of(torch.cat(boxes, 1), torch.cat(scores, 1), settings, every_shape)
    return [
        replace(detector.calibrated(of_frame), novelty=None if novelty is None else novelty[number])
        for number, of_frame in enumerate(merged)
    ]


def detect_split(detector: Detector, split: DetectSplit, name: str) -> tuple[list[Detections], float]:
    """Detections of all frames of a split, and frames per second."""
    with progress_bar() as progress:
        bar = progress.add_task(f"detect {name}", total=len(split), unit="frames", note="")
        started = time.perf_counter()
        detections: list[Detections] = []
        batch_size = detector.config.batch_size
        for start in range(0, len(split), batch_size):
            frames = split.frames.images[start : start + batch_size]
            detections += detect_at_scales(detector, frames)
            progress.advance(bar, len(frames))
        return detections, len(split) / (time.perf_counter() - started)
