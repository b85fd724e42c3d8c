"""Validation frames with labels and detections, for TensorBoard."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections

COUNT = 4
"""Number of frames that are drawn."""
_MIN_SIDE_PX = 512
_LABEL, _DETECTION = (240, 228, 66), (86, 180, 233)


def preview_images(
    split: DetectSplit, detections: Sequence[Detections], threshold: float, count: int = COUNT
) -> dict[str, NDArray[np.uint8]]:
    """RGB images (height, width, 3) by frame_id, of at most `count` frames evenly spaced over a split.

    Selected labels are yellow ellipses; detections with a score of at least `threshold` are blue boxes. Frames below
    512 px are enlarged by a whole factor, so that lines do not hide craters of a few pixels.
    """
    chosen = np.unique(np.linspace(0, len(split) - 1, min(count, len(split))).astype(int))
    names = split.frames.table["frame_id"].tolist()
    images = {}
    for number in chosen.tolist():
        grey = split.frames.images[number]
        factor = max(1, _MIN_SIDE_PX // max(grey.shape))
        image = cv2.cvtColor(grey.repeat(factor, 0).repeat(factor, 1), cv2.COLOR_GRAY2RGB)
        labels = split.labels[number]
        for cx, cy, a, b, theta in labels.ellipses[labels.selected].tolist():
            # The centre of the first pixel has the coordinate 0 in OpenCV, but 0.5 here.
            centre = _sixteenths(factor * cx - 0.5), _sixteenths(factor * cy - 0.5)
            axes = _sixteenths(factor * a), _sixteenths(factor * b)
            cv2.ellipse(image, centre, axes, np.degrees(theta), 0, 360, _LABEL, 1, cv2.LINE_AA, 4)
        frame_detections = detections[number]
        for x0, y0, x1, y1 in factor * frame_detections.boxes[frame_detections.scores >= threshold]:
            cv2.rectangle(image, (round(x0), round(y0)), (round(x1), round(y1)), _DETECTION, 1)
        images[names[number]] = image.astype(np.uint8)
    return images


def _sixteenths(value_px: float) -> int:
    """Convert pixels to OpenCV's integers with four fractional bits: sixteenths of a pixel."""
    return round(16 * value_px)
