"""Agreement of the light on the craters of a picture: in a picture of the Moon, one Sun lights all of them.

The grey levels inside the box of a crater increase in a direction that depends on the Sun. The agreement is the length
of the sum of these slopes over the sum of their lengths: 1 if all directions are equal, near 0 if they are random.
Steeper slopes count more, because shadows of neighbours disturb faint craters most under Suns below 4 degrees.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import Detections

MIN_CRATERS = 10
"""Minimum number of craters; the agreement of fewer craters is not meaningful."""
_MAX_CRATERS = 500
_MIN_SIDE_PX, _MIN_SCORE = 4, 0.5
_SIDE, _FLAT = 16, 1e-6
_STEPS = np.linspace(-1, 1, _SIDE)
_IN_DISC = np.hypot(_STEPS, _STEPS[:, None]) <= 1
_WEIGHTS = np.stack([np.where(_IN_DISC, _STEPS, 0.0), np.where(_IN_DISC, _STEPS[:, None], 0.0)])
"""Weights (2, 16, 16) of the grey levels of a box that is resized to 16 x 16 pixels.

The two weighted sums are proportional to the slope of the grey levels along x and y, in the disc inside the box."""


def agreement_of_light(image: NDArray[np.uint8], detections: Detections) -> tuple[float, float, int]:
    """Agreement (0 to 1) of the light on the craters of highest score, their median score, and their number.

    Only craters with a score of at least 0.5 and sides of at least 4 px count, at most 500. Without craters, all three
    values are 0.
    """
    height, width = image.shape
    best = np.argsort(-detections.scores, kind="stable")
    best = best[detections.scores[best] >= _MIN_SCORE]
    boxes = np.clip(np.rint(detections.boxes[best]), 0, [width, height, width, height]).astype(int)
    large = (boxes[:, 2:] - boxes[:, :2] >= _MIN_SIDE_PX).all(axis=1)
    boxes, scores = boxes[large][:_MAX_CRATERS], detections.scores[best][large][:_MAX_CRATERS]
    slopes, used = [], []
    for (x0, y0, x1, y1), score in zip(boxes, scores, strict=True):
        patch = cv2.resize(image[y0:y1, x0:x1], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        slope = np.tensordot(_WEIGHTS, patch.astype(np.float64))
        if np.linalg.norm(slope) > _FLAT:
            slopes.append(slope)
            used.append(score)
    if not slopes:
        return 0.0, 0.0, 0
    agreement = np.linalg.norm(np.sum(slopes, axis=0)) / np.linalg.norm(slopes, axis=1).sum()
    return float(agreement), float(np.median(used)), len(slopes)
