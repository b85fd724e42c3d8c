"""Craters that a detector found in one frame."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.frames import Array

_FLOOR_PX, _NOISE_SHARE, STATIC_SHARE = 0.15, 0.045, 0.075
"""Standard deviations of a detected centre on each axis, measured on the validation scenes of `shipped-nav`: a floor
and a share of the radius for errors that differ from frame to frame, and a share of the radius for errors that repeat
with a crater."""
_PER_SCORE, _USUAL_SCORE = 1.5, 0.8
"""Growth of the logarithm of the first kind of error with a falling score, and the score at which that error is as
stated."""
_SIZE_SHARE = 0.1
"""Standard deviation of a detected radius, divided by it."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """M detected craters."""

    centre_px: Array
    """Centres of the boxes (M, 2), image coordinates."""
    radius_px: Array
    """Half the geometric mean of width and height (M,), pixels."""
    score: Array
    """Scores (M,)."""

    @classmethod
    def of_boxes(cls, boxes: Array, scores: Array) -> "Sightings":
        """From boxes (M, 4) as x0, y0, x1, y1, pixels; sorted by decreasing radius."""
        size = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None)
        radius = np.sqrt(size.prod(axis=1)) / 2
        order = np.argsort(-radius)
        return cls((boxes[order, :2] + boxes[order, 2:]) / 2, radius[order], np.asarray(scores)[order])

    def __len__(self) -> int:
        return len(self.radius_px)

    @property
    def noise_px(self) -> Array:
        """Standard deviations of the errors that differ from frame to frame, on each axis (M,), pixels."""
        doubt = np.exp(_PER_SCORE * np.clip(_USUAL_SCORE - self.score, -0.2, 0.4))
        return np.hypot(_FLOOR_PX, _NOISE_SHARE * self.radius_px) * doubt

    @property
    def static_px(self) -> Array:
        """Standard deviations of the errors that repeat with a crater, on each axis (M,), pixels."""
        return STATIC_SHARE * self.radius_px

    @property
    def size_sigma(self) -> float:
        """Standard deviation of the logarithm of a radius."""
        return _SIZE_SHARE
