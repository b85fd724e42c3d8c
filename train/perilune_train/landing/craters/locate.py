"""Estimate a pose from one frame: near an expected pose, within an area, or anywhere over the catalogue."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import Fix, PosePrior, refine
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.search import N_TESTED, Area, search
from perilune_train.landing.craters.sightings import Sightings

_NEAR_PX = 6.0
"""Largest standard deviation of the expected pose, in pixels on the ground, for which no search is needed."""
_LEAST_AGREED = 8
_LEAST_SHARE = 0.25
"""Smallest number of sightings, and smallest share of the tested sightings, that must agree with a hypothesis."""
_AHEAD = 1.5
"""Smallest ratio of agreeing sightings between the best and the second-best hypothesis."""
_SIGMAS = 3.5
_REACHES = (1.0, 3.0)
"""Search radii, tried in turn, as multiples of the radius that the prior suggests. The larger one is tried because the
prior may be wrong."""
_NEAREST = 30
"""Number of nearest craters whose median height is taken as the height of the ground."""
_LEAST_MARGIN = 0.06
"""Smallest altitude margin in a search, as a share of the altitude. It is needed because the ground is not level."""


@dataclass(frozen=True, slots=True)
class Located:
    """A fix and how it was found."""

    fix: Fix
    """The fix."""
    searched: bool
    """True if a search found the fix; False if it was found near the expected pose."""


def locate(sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior) -> Located | None:
    """Estimate the pose of a frame from its craters, near the expected pose or by a search.

    Searches if the expected pose is too uncertain or no fix is found near it. Returns None if too few sightings match,
    or if two poses explain them about equally well.
    """
    ground_m = catalogue.ground_m(prior.pose.position_m, _NEAREST)
    altitude_m = float(prior.pose.position_m[2] - ground_m)
    sigma = np.sqrt(np.diag(prior.covariance))
    on_ground_m = float(np.hypot(sigma[:2].max(), altitude_m * sigma[3:5].max()))
    if on_ground_m * camera.fx_px < _NEAR_PX * max(altitude_m, 1.0):
        fix = refine(sightings, catalogue, camera, _around(prior.pose), prior.pose)
        if fix is not None:
            return Located(fix, searched=False)
    margin = max(_SIGMAS * float(sigma[2]) / max(altitude_m, 1.0), _LEAST_MARGIN)
    reach_m = max(_SIGMAS * on_ground_m, 20 * altitude_m / camera.fx_px)
    altitudes = altitude_m * max(1 - margin, 0.2), altitude_m * (1 + margin)
    heading = min(max(_SIGMAS * float(sigma[5]), np.radians(2)), np.pi)
    for factor in _REACHES:
        area = Area(prior.pose.position_m[:2], factor * reach_m, altitudes, heading)
        searched = lost_in_space(sightings, catalogue, camera, prior, area)
        if searched is not None:
            return searched
    return None


def lost_in_space(
    sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior, area: Area
) -> Located | None:
    """Search an area for the pose of a frame whose tilt is known to about 1 degree; None if uncertain."""
    hypotheses = search(sightings, catalogue, camera, prior.pose.rotation_camera_from_site, area)
    least = max(_LEAST_AGREED, _LEAST_SHARE * min(len(sightings), N_TESTED))
    if not hypotheses or hypotheses[0].n_agreed < least:
        return None
    if (
        len(hypotheses) > 1
        and hypotheses[0].n_agreed < _AHEAD * hypotheses[1].n_agreed
        and not _same(hypotheses[0].pose, hypotheses[1].pose)
    ):
        return None
    fix = refine(sightings, catalogue, camera, _around(hypotheses[0].pose), hypotheses[0].pose)
    return Located(fix, searched=True) if fix is not None else None


def _same(first: Pose, second: Pose) -> bool:
    """Whether two hypotheses differ by no more than the error expected of one hypothesis."""
    return float(np.linalg.norm(first.position_m - second.position_m)) < 0.1 * float(first.position_m[2])


def _around(pose: Pose) -> PosePrior:
    """A weak prior around a pose. The fix then depends on the sightings alone, and no sighting is counted twice."""
    return PosePrior(pose, np.diag(np.square([300.0] * 3 + [np.radians(3.0)] * 3)))
