"""Craters that a detector found in one frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array

_FLOOR_PX, _NOISE_SHARE, STATIC_SHARE = 0.15, 0.045, 0.075
"""Standard deviations of a detected centre per axis, measured on the validation scenes of `shipped-nav`. Errors that
differ from frame to frame have a floor and a share of the radius. Errors that repeat in every frame of a crater have a
share of the radius."""
_PER_SCORE, _USUAL_SCORE = 1.5, 0.8
"""The standard deviation that differs from frame to frame has the value above at `_USUAL_SCORE`. The logarithm of this
deviation grows by `_PER_SCORE` per unit of decreasing score."""
MAX_SIGHTINGS = 500
"""Largest number of craters of a frame that are matched in flight, which limits the time of a step."""
_SIZE_SHARE = 0.15
"""Standard deviation of a detected radius, as a share of the radius."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """M detected craters."""

    centre_px: Array
    """Centres of the boxes (M, 2), pixels, image coordinates."""
    radius_px: Array
    """Half the geometric mean of each box's width and height (M,), pixels."""
    score: Array
    """Scores (M,)."""

    @classmethod
    def of_boxes(cls, boxes: Array, scores: Array) -> "Sightings":
        """Sightings from boxes (M, 4) of x0, y0, x1, y1 in pixels, sorted by decreasing radius.

        Sightings of equal radius keep the order of their boxes.
        """
        scores = np.asarray(scores)
        size = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None)
        radius = np.sqrt(size.prod(axis=1)) / 2
        order = np.argsort(-radius, kind="stable")
        return cls((boxes[order, :2] + boxes[order, 2:]) / 2, radius[order], scores[order])

    def strongest(self, count: int = MAX_SIGHTINGS) -> "Sightings":
        """The `count` sightings with the highest scores, sorted by decreasing radius."""
        if len(self) <= count:
            return self
        return self.part(np.sort(np.argsort(-self.score, kind="stable")[:count]))

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.integer]) -> "Sightings":
        """The sightings with the given indices or mask."""
        return Sightings(self.centre_px[chosen], self.radius_px[chosen], self.score[chosen])

    def __len__(self) -> int:
        return len(self.radius_px)

    @property
    def noise_px(self) -> Array:
        """Standard deviations per axis (M,), pixels, of the errors that differ from frame to frame."""
        doubt = np.exp(_PER_SCORE * np.clip(_USUAL_SCORE - self.score, -0.2, 0.4))
        return np.hypot(_FLOOR_PX, _NOISE_SHARE * self.radius_px) * doubt

    @property
    def static_px(self) -> Array:
        """Standard deviations per axis (M,), pixels, of the errors that repeat in every frame of a crater."""
        return STATIC_SHARE * self.radius_px

    @property
    def size_sigma(self) -> float:
        """Standard deviation of the logarithm of a radius."""
        return _SIZE_SHARE
