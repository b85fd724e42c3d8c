"""Effect of one detected crater on the position that the landing filter computes from a frame."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import MIN_MATCHES, Fix, refine
from perilune_train.landing.craters.locate import weak_prior
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings

_MAX_OFFSET_RADII, _MAX_LOG_RATIO = 0.5, float(np.log(1.5))
"""Largest distance of the centres, in radii, and largest difference of the logarithms of the radii, of two sightings of
one crater."""


@dataclass(frozen=True, slots=True)
class SeenFrame:
    """A frame as the landing filter sees it."""

    sightings: Sightings
    """Craters that the detector finds with the settings of a flight."""
    camera: Camera
    """Intrinsics, without distortion."""
    true: Pose
    """True pose of the camera."""
    catalogue: Catalogue
    """Craters of the landing site."""


def same_crater(sightings: Sightings, one: Sightings) -> int | None:
    """Index of the sighting that shows the crater of `one` (one sighting); None if there is none."""
    offset = np.linalg.norm(sightings.centre_px - one.centre_px, axis=1) / one.radius_px
    ratio = np.abs(np.log(sightings.radius_px / one.radius_px))
    near = (offset <= _MAX_OFFSET_RADII) & (ratio <= _MAX_LOG_RATIO)
    return int(np.where(near, offset, np.inf).argmin()) if near.any() else None


def sentences_on_position(seen: SeenFrame, one: Sightings) -> list[str]:
    """The fix of a frame with and without the crater of `one` (one sighting), in sentences.

    Both fits start at the true pose, as in a flight that has found its position.
    """
    number = same_crater(seen.sightings, one)
    if number is None:
        return ["The filter does not see this crater: with the settings of a flight, the detector does not find it."]
    whole = _fix(seen, seen.sightings)
    if whole is None:
        return [f"The frame gives no position: fewer than {MIN_MATCHES} detections match the catalogue."]
    matched = np.flatnonzero(whole.sighting == number)
    if not len(matched):
        return [
            f"The position does not use this detection: no crater of the catalogue matches it. {len(whole.sighting)} "
            f"other detections give an error of {_error_m(whole, seen):.2f} m."
        ]
    without = _fix(seen, seen.sightings.part(np.arange(len(seen.sightings)) != number))
    if without is None:
        return [f"Without this crater there is no position: fewer than {MIN_MATCHES} detections match the catalogue."]
    moved_m = float(np.linalg.norm(whole.pose.position_m - without.pose.position_m))
    return [
        f"The position moves by {moved_m:.3f} m if this crater is left out of {len(whole.sighting)} matched craters. "
        f"The weight of this crater is {whole.weight[matched[0]]:.2f} of 1.",
        f"Standard deviation of the position: {_sigma_m(whole):.3f} m with this crater, {_sigma_m(without):.3f} m "
        f"without it.",
        f"Error of the position: {_error_m(whole, seen):.3f} m with this crater, {_error_m(without, seen):.3f} m "
        "without it.",
    ]


def _fix(seen: SeenFrame, sightings: Sightings) -> Fix | None:
    return refine(sightings, seen.catalogue, seen.camera, weak_prior(seen.true), seen.true)


def _sigma_m(fix: Fix) -> float:
    """Standard deviation of the position over all three axes, metres."""
    return float(np.sqrt(np.trace(fix.covariance[:3, :3])))


def _error_m(fix: Fix, seen: SeenFrame) -> float:
    position_m: Array = fix.pose.position_m
    return float(np.linalg.norm(position_m - seen.true.position_m))
