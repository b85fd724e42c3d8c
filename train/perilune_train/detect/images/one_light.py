"""Warn about pictures that are not of the Moon.

In a lunar picture, the Sun lights all craters from the same side. The grey levels inside the box of a crater
increase in a direction that depends on the Sun. `agreement_of_light` is the length of the mean of these directions
(unit vectors): 1 if all directions are equal, near 0 if they are random.

With the installed detector, 192 lunar pictures (12 crops of Narrow Angle Camera images, 180 rendered frames) have an
agreement of 0.87 to 0.99. Of 35 other pictures (from the wheels of scikit-image 0.26 and scikit-learn 1.9, and six
charts of docs/pictures), 26 have ten or more detections, with an agreement of 0.04 to 0.79. `MIN_AGREEMENT` was chosen
on every second picture. Among the remaining pictures with ten or more detections, it flags none of the 96 lunar
pictures and all 12 pictures of other things (`benchmarks/train/one_light.py`, `--most 60`).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import Detections

MIN_AGREEMENT = 0.8
"""A picture with a lower agreement is flagged as possibly not lunar."""
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


def doubt_of(image: NDArray[np.uint8], detections: Detections) -> str | None:
    """Return a warning if a grey image (height, width) does not look like the Moon, else None."""
    agreement, count = agreement_of_light(image, detections)
    if count < MIN_CRATERS or agreement >= MIN_AGREEMENT:
        return None
    got = f"got {agreement:.2f}, expected at least {MIN_AGREEMENT} under one Sun; is it a picture of the Moon?"
    return f"agreement (0 to 1) of the light directions of {count} craters: {got}"


def agreement_of_light(image: NDArray[np.uint8], detections: Detections) -> tuple[float, int]:
    """Return the agreement (0 to 1) of the light on the craters of highest score, and their number."""
    height, width = image.shape
    best = np.argsort(-detections.scores, kind="stable")
    best = best[detections.scores[best] >= _MIN_SCORE]
    boxes = np.clip(np.rint(detections.boxes[best]), 0, [width, height, width, height]).astype(int)
    boxes = boxes[(boxes[:, 2:] - boxes[:, :2] >= _MIN_SIDE_PX).all(axis=1)][:_MAX_CRATERS]
    directions = []
    for x0, y0, x1, y1 in boxes:
        patch = cv2.resize(image[y0:y1, x0:x1], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
        slope = np.tensordot(_WEIGHTS, patch.astype(np.float64))
        if (length := float(np.linalg.norm(slope))) > _FLAT:
            directions.append(slope / length)
    if not directions:
        return 0.0, 0
    return float(np.linalg.norm(np.mean(directions, axis=0))), len(directions)
