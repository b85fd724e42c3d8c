"""Locate craters in space from detections in two images with known poses."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings

_CLASSES_PX = (30.0, 12.0, 5.0, 0.0)
"""Smallest radius of each size class, pixels, largest first. The heights of one class narrow the search for craters of
the next class."""
_RELIEF_M = 30.0
"""Standard deviation of heights, metres, assumed before any crater is matched."""
_MIN_RELIEF_M = 1.0
_SIZE_SIGMA = 0.15
"""Standard deviation of the logarithm of the ratio between two measured radii of one crater."""
_GATE = 3.0
"""Largest difference between matched craters, in standard deviations, on each axis."""
_NEIGHBOURS = 16
"""Number of matched craters whose median height is taken as the height of the ground around them."""


@dataclass(frozen=True, slots=True)
class View:
    """One image with known pose, and its detections."""

    camera: Camera
    """Intrinsics, without distortion."""
    pose: Pose
    """Pose of the camera."""
    sightings: Sightings
    """Detected craters (M)."""

    @property
    def rays(self) -> Array:
        """Directions (M, 3) of the craters, O_L, with z = -1."""
        towards = self.camera.rays(self.sightings.centre_px) @ self.pose.rotation_camera_from_site
        return np.asarray(towards / -towards[:, 2:])

    def place_m(self, height_m: Array) -> Array:
        """Points (M, 2), metres, O_L, where the rays reach given heights (M,), metres."""
        return np.asarray(self.pose.position_m[:2] + self.rays[:, :2] * (self.pose.position_m[2] - height_m)[:, None])

    def radius_m(self, height_m: Array) -> Array:
        """Radii (M,), metres, of the craters, taken as level circles at given heights (M,), metres."""
        rotation_camera_from_site = self.pose.rotation_camera_from_site
        centres = camera_from_site(
            np.column_stack([self.place_m(height_m), height_m]), self.pose.position_m, rotation_camera_from_site
        )
        guess_m = self.sightings.radius_px * centres[:, 2] / self.camera.fx_px
        level = np.tile(rotation_camera_from_site[:, 2], (len(centres), 1))
        boxes = project_circles(self.camera, centres, level, guess_m).bounding_boxes()
        size_px = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)) / 2
        return np.asarray(guess_m * self.sightings.radius_px / size_px)


@dataclass(frozen=True, slots=True)
class Ground:
    """The ground surface, estimated from the heights of matched craters."""

    place_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Horizontal positions of the craters (N, 2), metres, O_L."""
    height_m: Array = field(default_factory=lambda: np.zeros(0))
    """Heights of the craters (N,), metres."""
    sigma_m: float = _RELIEF_M
    """Standard deviation of a crater's height relative to the height that `at` returns, metres."""

    def at(self, place_m: Array, without_nearest: bool = False) -> Array:
        """Heights (M,), metres, of the ground at points (M, 2).

        A height is the median of the nearest craters, or of all craters if there are few; 0 without craters.
        `without_nearest` leaves out the crater nearest to each point.
        """
        if len(self.height_m) <= _NEIGHBOURS:
            return np.full(len(place_m), np.median(self.height_m) if len(self.height_m) else 0.0)
        _, near = KDTree(self.place_m).query(place_m, _NEIGHBOURS + without_nearest)
        return np.asarray(np.median(self.height_m[near[:, int(without_nearest) :]], axis=1))


@dataclass(frozen=True, slots=True)
class Matched:
    """N craters seen in both images."""

    first: NDArray[np.intp]
    """Indices (N,) among the sightings of the first view."""
    second: NDArray[np.intp]
    """Indices (N,) among the sightings of the second view."""
    centre_m: Array
    """Centres (N, 3), metres, O_L."""
    radius_m: Array
    """Radii (N,), metres."""
    apart_m: Array
    """Horizontal distance (N, 2) between the two rays at the height of the centre, metres, O_L."""
    score: Array
    """The lower score of the two detections (N,)."""


def matched(first: View, second: View) -> Matched:
    """Match the craters of two views, largest first, and intersect their rays.

    The height of a single small crater is far less accurate than the height of the ground around it, so a crater gets
    the median height of its neighbours.
    """
    ground, pairs = Ground(), np.zeros((0, 2), np.intp)
    for number, least_px in enumerate(_CLASSES_PX):
        most_px = _CLASSES_PX[number - 1] if number else np.inf
        # A crater near the limit of a size class may belong to the neighbouring class in the other view.
        parts = [
            np.flatnonzero(
                (view.sightings.radius_px >= share * least_px) & (view.sightings.radius_px < most_px / share)
            )
            for view, share in ((first, 1.0), (second, 0.75))
        ]
        parts[0] = parts[0][first.sightings.radius_px[parts[0]] < most_px]
        parts[1] = np.setdiff1d(parts[1], pairs[:, 1])
        new = _pairs(first, second, parts, ground)
        pairs = np.concatenate([pairs, new])
        ground = _ground(first, second, pairs)
    heights = ground.at(ground.place_m)
    places = [
        view.place_m(_spread(heights, chosen, view))[chosen]
        for view, chosen in zip((first, second), pairs.T, strict=True)
    ]
    radii = [
        view.radius_m(_spread(heights, chosen, view))[chosen]
        for view, chosen in zip((first, second), pairs.T, strict=True)
    ]
    score = np.minimum(first.sightings.score[pairs[:, 0]], second.sightings.score[pairs[:, 1]])
    middle = (places[0] + places[1]) / 2
    return Matched(
        pairs[:, 0],
        pairs[:, 1],
        np.column_stack([middle, heights]),
        np.sqrt(radii[0] * radii[1]),
        places[1] - places[0],
        score,
    )


def _spread(values: Array, chosen: NDArray[np.intp], view: View) -> Array:
    """Place the values of the chosen sightings in an array for all sightings; 0 elsewhere."""
    every = np.zeros(len(view.sightings))
    every[chosen] = values
    return every


def _pairs(first: View, second: View, parts: list[NDArray[np.intp]], ground: Ground) -> NDArray[np.intp]:
    """Pairs (N, 2) of sightings that are mutual nearest neighbours in ground position and size."""
    if not len(parts[0]) or not len(parts[1]):
        return np.zeros((0, 2), np.intp)
    baseline = second.pose.position_m - first.pose.position_m
    along = baseline[:2] / np.linalg.norm(baseline[:2])
    across = np.array([-along[1], along[0]])
    steepness = float(np.linalg.norm(baseline[:2]) / first.pose.position_m[2])
    points = []
    for view, part in zip((first, second), parts, strict=True):
        height = np.zeros(len(view.sightings))
        for _ in range(3):
            height = ground.at(view.place_m(height))
        position, radius = view.place_m(height)[part], view.radius_m(height)[part]
        noise_m = radius / view.sightings.radius_px[part] * view.sightings.noise_px[part]
        points.append((position, radius, noise_m))
    typical = float(np.median(np.concatenate([noise for _, _, noise in points]))) * 2**0.5
    scale = np.array([np.hypot(steepness * ground.sigma_m, typical), typical, _SIZE_SIGMA]) * _GATE
    spots = [
        np.column_stack([position @ along, position @ across, np.log(radius)]) / scale for position, radius, _ in points
    ]
    trees = [KDTree(spot) for spot in spots]
    _, forth = trees[1].query(spots[0], p=2)
    _, back = trees[0].query(spots[1], p=2)
    mutual = np.flatnonzero(back[forth] == np.arange(len(forth)))
    near = (np.abs(spots[0][mutual] - spots[1][forth[mutual]]) < 1).all(axis=1)
    chosen = mutual[near]
    return np.column_stack([parts[0][chosen], parts[1][forth[chosen]]])


def _ground(first: View, second: View, pairs: NDArray[np.intp]) -> Ground:
    """The ground from matched craters: a crater has the height at which its two rays are closest."""
    start = [view.pose.position_m for view in (first, second)]
    rays = [view.rays[chosen] for view, chosen in zip((first, second), pairs.T, strict=True)]
    # Both rays have z = -1, so their distance is a linear function of the height.
    apart = start[1][:2] + rays[1][:, :2] * start[1][2] - start[0][:2] - rays[0][:, :2] * start[0][2]
    by_height = rays[0][:, :2] - rays[1][:, :2]
    height = -(apart * by_height).sum(axis=1) / np.square(by_height).sum(axis=1)
    position = start[0][:2] + rays[0][:, :2] * (start[0][2] - height)[:, None]
    raw = Ground(position, height)
    off = height - raw.at(position, without_nearest=True)
    sigma = max(1.4826 * float(np.median(np.abs(off))), _MIN_RELIEF_M) if len(off) > _NEIGHBOURS else _RELIEF_M
    good = np.abs(off) < 4 * sigma
    kept = Ground(position[good], height[good], sigma)
    return Ground(position, np.where(good, height, kept.at(position)), sigma)
