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
PREDICTED_FLOOR_PX, PREDICTED_NOISE, PREDICTED_STATIC = 0.12, 0.62, 0.75
"""If the detector predicts the standard deviation of a centre: errors that differ from frame to frame have a floor,
pixels, and a share of this deviation; errors that repeat in every frame have the other share. Measured on the
validation scenes of `shipped-nav` (docs/notebook/2026-11-28-deviations.md)."""


@dataclass(frozen=True, slots=True)
class Sightings:
    """M detected craters."""

    centre_px: Array
    """Centres of the boxes (M, 2), pixels, image coordinates."""
    radius_px: Array
    """Half the geometric mean of each box's width and height (M,), pixels."""
    score: Array
    """Scores (M,)."""
    sigma_px: Array | None = None
    """Standard deviation per axis of each centre, as the detector predicts it (M,), pixels: root mean square of x and
    y. NaN in rows without a prediction; None if there are no predictions."""

    @classmethod
    def of_boxes(cls, boxes: Array, scores: Array, centre_sigmas_px: Array | None = None) -> "Sightings":
        """Sightings from boxes (M, 4) of x0, y0, x1, y1 in pixels, sorted by decreasing radius.

        `centre_sigmas_px` (M, 2) are predicted standard deviations of the centres along x and y, pixels; NaN if
        unknown. Sightings of equal radius keep the order of their boxes.
        """
        scores = np.asarray(scores)
        sigma_px = None if centre_sigmas_px is None else np.sqrt(np.mean(np.square(centre_sigmas_px), axis=1))
        size = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None)
        radius = np.sqrt(size.prod(axis=1)) / 2
        order = np.argsort(-radius, kind="stable")
        centre = (boxes[:, :2] + boxes[:, 2:]) / 2
        return cls(centre, radius, scores, sigma_px).part(order)

    def strongest(self, count: int = MAX_SIGHTINGS) -> "Sightings":
        """The `count` sightings with the highest scores, sorted by decreasing radius."""
        if len(self) <= count:
            return self
        return self.part(np.sort(np.argsort(-self.score, kind="stable")[:count]))

    def part(self, chosen: NDArray[np.bool_] | NDArray[np.integer]) -> "Sightings":
        """The sightings with the given indices or mask."""
        sigma_px = None if self.sigma_px is None else self.sigma_px[chosen]
        return Sightings(self.centre_px[chosen], self.radius_px[chosen], self.score[chosen], sigma_px)

    def without_predictions(self) -> "Sightings":
        """The sightings without predicted standard deviations."""
        return Sightings(self.centre_px, self.radius_px, self.score)

    def __len__(self) -> int:
        return len(self.radius_px)

    @property
    def noise_px(self) -> Array:
        """Standard deviations per axis (M,), pixels, of the errors that differ from frame to frame."""
        doubt = np.exp(_PER_SCORE * np.clip(_USUAL_SCORE - self.score, -0.2, 0.4))
        usual = np.hypot(_FLOOR_PX, _NOISE_SHARE * self.radius_px) * doubt
        if self.sigma_px is None:
            return usual
        return np.where(np.isnan(self.sigma_px), usual, np.hypot(PREDICTED_FLOOR_PX, PREDICTED_NOISE * self.sigma_px))

    @property
    def static_px(self) -> Array:
        """Standard deviations per axis (M,), pixels, of the errors that repeat in every frame of a crater."""
        usual = STATIC_SHARE * self.radius_px
        if self.sigma_px is None:
            return usual
        return np.where(np.isnan(self.sigma_px), usual, PREDICTED_STATIC * self.sigma_px)

    @property
    def size_sigma(self) -> float:
        """Standard deviation of the logarithm of a radius."""
        return _SIZE_SHARE
