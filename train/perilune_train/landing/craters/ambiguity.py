"""Probability that each match of a fix is correct, given the other craters near the sighting.

A catalogue with errors has several craters within the gate of a sighting where craters are dense. The one-to-one
assignment takes one of them, and a wrong one repeats from frame to frame, so that the filter takes the error for
information. A filter that leaves out ambiguous matches loses little, because a frame has hundreds of matches.
"""

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import MIN_SIZE_RATIO, SIZE_SPAN, Fix
from perilune_train.landing.craters.matching import Circles
from perilune_train.landing.craters.neighbours import within_reach
from perilune_train.landing.craters.projection import projected
from perilune_train.landing.craters.sightings import Sightings

_REACH_SIGMAS = 4.0
"""Largest distance of a crater from a sighting along each axis, standard deviations."""
_REACH_PX = 10.0
"""Largest distance from the image of the craters that are considered, pixels."""


def match_probability(sightings: Sightings, catalogue: Catalogue, camera: Camera, fix: Fix) -> Array:
    """Probability that each match of a fix is correct (K,).

    The alternatives are the other craters of the catalogue near the sighting, and a false sighting. Half of all
    sightings are assumed to be false.
    """
    least_px = MIN_SIZE_RATIO * float(sightings.radius_px.min())
    expected = projected(catalogue, camera, fix.pose, _REACH_PX, least_px)
    placed_px = camera.fx_px / expected.depth_m * catalogue.position_sigma_m
    matched = fix.sighting
    noise_px = np.hypot(sightings.noise_px, sightings.static_px)[matched]
    seen = Circles(sightings.centre_px[matched], np.log(sightings.radius_px[matched]), noise_px)
    craters = Circles(expected.centre_px, np.log(expected.radius_px), placed_px)
    reach_px = _REACH_SIGMAS * np.hypot(noise_px, np.max(placed_px, initial=0.0))
    first, crater = within_reach(seen.centre_px, reach_px, craters.centre_px)
    size_sigma = float(np.hypot(sightings.size_sigma, catalogue.radius_sigma_share))
    clutter = len(expected.index) / (camera.width_px * camera.height_px * SIZE_SPAN)
    return _probability(
        seen,
        craters,
        first,
        crater,
        expected.index[crater] == np.repeat(fix.crater, np.diff(first)),
        (size_sigma, clutter),
    )


@compiled
def _probability(
    seen: Circles,
    craters: Circles,
    first: NDArray[np.int64],
    crater: NDArray[np.int64],
    is_match: NDArray[np.bool_],
    limits: tuple[float, float],
) -> Array:
    """`match_probability` from pairs listed by `within_reach`.

    `is_match` tells which pairs are matches of the fix. `limits` are the standard deviation of a size and the density
    of false sightings (per pixel squared and per unit of size).
    """
    size_sigma, clutter = limits
    probability = np.zeros(len(seen.size))
    for i in range(len(seen.size)):
        total = clutter
        for k in range(first[i], first[i + 1]):
            j = crater[k]
            variance = seen.sigma_px[i] ** 2 + craters.sigma_px[j] ** 2
            apart = (seen.centre_px[i, 0] - craters.centre_px[j, 0]) ** 2
            apart = (apart + (seen.centre_px[i, 1] - craters.centre_px[j, 1]) ** 2) / variance
            sized = ((seen.size[i] - craters.size[j]) / size_sigma) ** 2
            likelihood = np.exp(-(apart + sized) / 2) / ((2 * np.pi) ** 1.5 * variance * size_sigma)
            total += likelihood
            if is_match[k]:
                probability[i] = likelihood
        probability[i] /= total
    return probability
