"""Estimate a pose from one frame: near an expected pose, in an area, or anywhere over the catalogue."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.fix import MIN_MATCHES, Fix, PosePrior, refine
from perilune_train.landing.craters.pair_vote import pair_candidates
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.search import Area, search
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.craters.vote import (
    LOST,
    LOST_FINELY,
    Candidate,
    SearchRange,
    Support,
    candidates,
    refined,
    support,
)

NEAR_PX = 6.0
"""Largest standard deviation of the expected pose, in pixels on the ground, for which no search is needed."""
_NEAR_SIGMAS, _SEARCH_SIGMAS, _SURE_SIGMAS = 5.0, 10.0, 30.0
"""Smallest support, in standard deviations of chance: of a fix near the expected pose, of a fix by a search, and of a
fix at which a search stops without trying further candidates."""
_CLEAR_SIGNIFICANCE, _CLEARLY_AHEAD = 14.0, 1.3
"""Smallest significance of the best refined candidate of a camera that is lost in space, and smallest ratio to the
significance of the next different pose. On validation scenes, wrong poses reach 11, and the true pose has 14 to 135."""
_AHEAD = 1.3
"""Smallest ratio between the support of the best and the second-best pose of a search."""
_MAX_TILT_RAD = float(np.radians(5))
"""A search knows the tilt to about a degree. Fixes with a tilt that differs by more than this are wrong: over level
ground, a tilt has nearly the effect of a displacement, and some craters agree."""
_WEAK_TILT_RAD, _KNOWN_TILT_RAD = float(np.radians(3)), float(np.radians(1))
"""Standard deviations of a rotation: of a weak prior, and of the tilt of a camera that is lost in space."""
_N_REFINED = 4
"""Number of refined candidates from which fixes are computed."""
_N_POLISHED = 3
"""Largest number of fits from a candidate."""
_STILL_PX = 0.5
"""Fits end if the last one moves the image by less than this, pixels."""
_ATTEMPTS = ((2.0, 500_000), (3.5, 4_000_000), (10.5, 4_000_000))
"""Searches in the order in which they are tried: range in standard deviations of the prior, and `max_tried` of
`pair_candidates`. The first search is the fastest. The last has a large range, because the prior may be wrong."""
_NEAREST = 30
"""Number of nearest craters whose median height is taken as the height of the ground."""
_MIN_MARGIN, _MIN_SHIFT_PX, _MIN_HEADING_RAD = 0.06, 20.0, float(np.radians(2))
"""Smallest ranges of a search: of the altitude, as a share, of the shift and of the heading. The ground is not
level."""


@dataclass(frozen=True, slots=True)
class Located:
    """A fix, and whether it needed a search."""

    fix: Fix
    """The fix."""
    searched: bool
    """True if a search found the fix; False if it was found near the expected pose."""


def locate(sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior) -> Located | None:
    """Estimate the pose of a frame from its craters, near the expected pose or by a search.

    Searches if the expected pose is too uncertain or no fix is found near it. Returns None if too few sightings match,
    or if two poses explain them about equally well.
    """
    if len(sightings) < MIN_MATCHES:
        return None
    ground_m = ground_below_m(catalogue, prior.pose.position_m)
    altitude_m = max(float(prior.pose.position_m[2] - ground_m), 1.0)
    sigma = np.sqrt(np.diag(prior.covariance))
    start_px = expected_error_px(prior, altitude_m, camera)
    if start_px < NEAR_PX:
        fix = refine(sightings, catalogue, camera, weak_prior(prior.pose), prior.pose, start_px)
        if fix is not None and support(sightings, catalogue, camera, fix.pose).sigmas >= _NEAR_SIGMAS:
            return Located(fix, searched=False)
    for sigmas, max_tried in _ATTEMPTS:
        margin = max(sigmas * float(sigma[2]) / altitude_m, _MIN_MARGIN)
        limits = SearchRange(
            ground_m,
            sigmas * float(sigma[:2].max()),
            max(sigmas * float(sigma[3:5].max()) * camera.fx_px, _MIN_SHIFT_PX),
            (np.log(max(1 - margin, 0.2)), np.log(1 + margin)),
            min(max(sigmas * float(sigma[5]), _MIN_HEADING_RAD), np.pi),
        )
        voted, is_sure = pair_candidates(sightings, catalogue, camera, prior.pose, limits, max_tried)
        if not is_sure and sigmas == _ATTEMPTS[0][0]:
            continue
        poses = [candidate.pose for candidate in voted[:_N_REFINED]]
        fix = _best(sightings, catalogue, camera, poses, min(float(sigma[3:5].max()), _KNOWN_TILT_RAD))
        if fix is not None:
            return Located(fix, searched=True)
    return None


def ground_below_m(catalogue: Catalogue, position_m: Array) -> float:
    """Height of the ground, metres, that a search assumes below a position (2,) or (3,), O_L."""
    return catalogue.ground_m(position_m, _NEAREST)


def expected_error_px(prior: PosePrior, altitude_m: float, camera: Camera) -> float:
    """Standard deviation, pixels, of the expected pose's error in the image at an altitude above the ground."""
    sigma = np.sqrt(np.diag(prior.covariance))
    on_ground_px = float(np.hypot(sigma[:2].max() / altitude_m, sigma[3:5].max())) * camera.fx_px
    # Errors of altitude and heading move the edges of the image, but not its centre.
    edge_px = float(np.hypot(sigma[2] / altitude_m, sigma[5])) * camera.width_px / 2
    return float(np.hypot(on_ground_px, edge_px))


def lost_in_space(
    sightings: Sightings, catalogue: Catalogue, camera: Camera, prior: PosePrior, area: Area
) -> Located | None:
    """Search an area for the pose of a frame whose tilt is known to about 1 degree; None if uncertain.

    Pairs of the largest craters are tried first, because this is fast. If they lead to no fix, the sightings vote (see
    vote.py), first with coarse bins and then with fine bins.
    """
    rotation_camera_from_site = prior.pose.rotation_camera_from_site
    hypotheses = search(sightings, catalogue, camera, rotation_camera_from_site, area)
    fix = _best(sightings, catalogue, camera, [hypothesis.pose for hypothesis in hypotheses], _KNOWN_TILT_RAD)
    if fix is None and len(sightings) >= MIN_MATCHES:
        ground_m = ground_below_m(catalogue, area.centre_m)
        low, high = area.altitude_m
        middle_m = float(np.sqrt(low * high))
        middle = Pose(np.array([*area.centre_m, ground_m + middle_m]), rotation_camera_from_site)
        log_altitude = np.log(low / middle_m), np.log(high / middle_m)
        limits = SearchRange(ground_m, area.reach_m, 0.0, log_altitude, area.heading_rad)
        for effort in (LOST, LOST_FINELY):
            voted = refined(
                sightings, catalogue, camera, candidates(sightings, catalogue, camera, middle, limits, effort)
            )
            if is_clear(voted):
                fix = _best(sightings, catalogue, camera, [voted[0].pose], _KNOWN_TILT_RAD)
                break
    return Located(fix, searched=True) if fix is not None else None


def is_clear(voted: list[Candidate]) -> bool:
    """Whether the first refined candidate is significant enough to be the true pose."""
    if not voted or voted[0].significance < _CLEAR_SIGNIFICANCE:
        return False
    others = (later.significance for later in voted[1:] if not _same(later.pose, voted[0].pose))
    return voted[0].significance >= _CLEARLY_AHEAD * max(others, default=0.0)


def _best(sightings: Sightings, catalogue: Catalogue, camera: Camera, poses: list[Pose], tilt_rad: float) -> Fix | None:
    """The fix with the most support among the fixes from some poses; None if it may be chance.

    `tilt_rad` is the standard deviation of the poses' tilt.
    """
    fixes: list[tuple[Support, Fix]] = []
    for pose in poses:
        agreed, fix = _polished(sightings, catalogue, camera, pose, tilt_rad)
        if fix is None or _tilt(fix.pose, pose) > _MAX_TILT_RAD:
            continue
        if agreed.sigmas >= _SURE_SIGMAS:
            return fix
        fixes.append((agreed, fix))
    if not fixes:
        return None
    fixes.sort(key=lambda pair: -pair[0].excess)
    best, fix = fixes[0]
    others = (other.excess for other, later in fixes[1:] if not _same(later.pose, fix.pose))
    if best.sigmas < _SEARCH_SIGMAS or best.excess < _AHEAD * max(others, default=0.0):
        return None
    return fix


def _polished(
    sightings: Sightings, catalogue: Catalogue, camera: Camera, pose: Pose, tilt_rad: float
) -> tuple[Support, Fix | None]:
    """The fix from a candidate of a search, and its support.

    A candidate is off by several pixels at the edges of the frame. A free fit from there may match only a part of the
    frame, with a wrong tilt. Therefore the first fit has a prior on the tilt, with standard deviation `tilt_rad`. Free
    fits follow, each from the previous result, while they move the image and the support grows.
    """
    first = refine(sightings, catalogue, camera, weak_prior(pose, tilt_rad), pose)
    best, agreed = None, Support(0, 0.0, 1.0)
    start = pose if first is None else first.pose
    ground_m = catalogue.ground_m(start.position_m, _NEAREST)
    for _ in range(_N_POLISHED):
        fix = refine(sightings, catalogue, camera, weak_prior(start), start)
        if fix is None:
            break
        later = support(sightings, catalogue, camera, fix.pose)
        if later.excess <= agreed.excess:
            break
        moved_px = _moved_px(camera, start, fix.pose, ground_m)
        best, agreed, start = fix, later, fix.pose
        if agreed.sigmas < _NEAR_SIGMAS or moved_px < _STILL_PX:
            break
    return agreed, best


def _moved_px(camera: Camera, first: Pose, second: Pose, ground_m: float) -> float:
    """Largest motion of the image's corners and middle, pixels, from one pose to another over level ground."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    place_px = np.array([[0.5, 0.5], [right, 0.5], [0.5, bottom], [right, bottom], [right / 2, bottom / 2]])
    ray = camera.rays(place_px)
    down = ray @ first.rotation_camera_from_site
    if not (down[:, 2] < 0).all():
        return np.inf
    ground = first.position_m + down * ((ground_m - first.position_m[2]) / down[:, 2:])
    later = (ground - second.position_m) @ second.rotation_camera_from_site.T
    return float(np.abs(later[:, :2] / later[:, 2:] - ray[:, :2] / ray[:, 2:]).max() * camera.fx_px)


def _tilt(first: Pose, second: Pose) -> float:
    """Angle between the optical axes of two poses, radians."""
    cos = float(first.rotation_camera_from_site[2] @ second.rotation_camera_from_site[2])
    return float(np.arccos(np.clip(cos, -1.0, 1.0)))


def _same(first: Pose, second: Pose) -> bool:
    """Whether the distance of two poses is below a tenth of the height."""
    return float(np.linalg.norm(first.position_m - second.position_m)) < 0.1 * float(first.position_m[2])


def weak_prior(pose: Pose, tilt_rad: float = _WEAK_TILT_RAD) -> PosePrior:
    """A prior around a pose.

    By default it is weak: the fix then depends on the sightings alone, and no sighting is counted twice.
    """
    return PosePrior(pose, np.diag(np.square([300.0] * 3 + [tilt_rad, tilt_rad, _WEAK_TILT_RAD])))
