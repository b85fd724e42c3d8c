"""Find the position of a camera from pairs of craters, with or without a rough prior position.

Two craters determine position, heading and altitude of a level camera. Steps:

1. `_in_reach` selects the craters that the camera may see from the area.
2. `_Pairs.of` forms ordered pairs of sightings and of craters.
3. `_placements` looks up each pair of sightings among the pairs of craters in a tree over their ratios of size to
   separation, their separation and their direction. Each hit gives a placement of the camera.
4. `_agreed` counts the sightings that agree with a crater under each placement.
5. `search` returns the best distinct placements as hypotheses.

The caller accepts a hypothesis only if it explains far more sightings than the second best.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.catalogue import Catalogue, Chosen
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings

_N_PAIRED = 18
"""Number of sightings that form pairs. The largest sightings are used, because large craters are rare."""
_N_FIRST, N_TESTED = 24, 60
"""Number of sightings on which all placements are tested, and on which the best are tested; the largest sightings."""
_MIN_SEPARATION = 0.1
"""Smallest separation of a pair, divided by the width of the image."""
_SIZE_SIGMA, _SIGMAS, _FARTHEST = 0.12, 3.5, 4.5
"""Standard deviation of the logarithm of a size; number of standard deviations that correspond to the limits of an
area's altitude and heading; largest distance, in standard deviations, between a pair of sightings and a pair of
craters."""
_TEST_PX, _TEST_SIZE = 4.0, 0.35
"""Largest distance, and largest difference of the logarithms of the sizes, at which a sighting agrees with a crater."""
_MAX_PAIRED, _MAX_HITS, _MAX_TESTED, _MAX_RETURNED = 800, 150, 1000, 5
"""Largest numbers of: craters that form pairs, the largest first; placements for a pair of sightings; placements that
are tested on more sightings; returned hypotheses. They limit the time of a search."""


@dataclass(frozen=True, slots=True)
class Area:
    """The area in which the camera may be."""

    centre_m: Array
    """Centre of the search (2,), metres, O_L."""
    reach_m: float
    """Largest distance of the camera from the centre, over ground, metres."""
    altitude_m: tuple[float, float]
    """Smallest and largest altitude above the ground, metres."""
    heading_rad: float
    """Largest deviation of the true heading from the heading of the assumed attitude, radians; pi if unknown."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A possible pose of the camera."""

    pose: Pose
    """The pose."""
    n_agreed: int
    """Number of sightings that agree with a crater."""


def search(
    sightings: Sightings, catalogue: Catalogue, camera: Camera, rotation_camera_from_site: Array, area: Area
) -> list[Hypothesis]:
    """The best hypotheses, best first; empty if no placement fits.

    Each hypothesis is at least 10 px on the ground away from all better hypotheses. `rotation_camera_from_site` is the
    assumed attitude; its tilt must be correct to about a degree.
    """
    rays = camera.rays(sightings.centre_px) @ rotation_camera_from_site
    offset, size = rays[:, :2] / -rays[:, 2:], sightings.radius_px / camera.fx_px
    if len(sightings) < 3:
        return []
    paired = _in_reach(catalogue, camera, sightings.radius_px[:_N_PAIRED], area)
    local = _in_reach(catalogue, camera, sightings.radius_px[:N_TESTED], area)
    paired = paired.part(np.argsort(-paired.radius_m, kind="stable")[:_MAX_PAIRED])
    if len(paired) < 3:
        return []
    placements = _placements(offset[:_N_PAIRED], size[:_N_PAIRED], paired, camera, area)
    if not len(placements.altitude_m):
        return []
    # To save time, test all placements on few sightings, and only the best placements on more.
    agreed = _agreed(placements, offset[:_N_FIRST], size[:_N_FIRST], local, camera)
    placements = placements.part(np.argsort(-agreed, kind="stable")[:_MAX_TESTED])
    agreed = _agreed(placements, offset[:N_TESTED], size[:N_TESTED], local, camera)
    ground_m = float(np.median(local.centre_m[:, 2]))
    best: list[Hypothesis] = []
    for k in np.argsort(-agreed, kind="stable"):
        altitude_m, turn = placements.altitude_m[k], placements.heading_rad[k]
        position = np.array([*placements.position_m[k], ground_m + altitude_m])
        apart_m = 10 * altitude_m / camera.fx_px
        if any(np.linalg.norm(better.pose.position_m - position) < apart_m for better in best):
            continue
        heading = np.eye(3)
        heading[:2, :2] = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        best.append(Hypothesis(Pose(position, rotation_camera_from_site @ heading), int(agreed[k])))
        if len(best) == _MAX_RETURNED:
            break
    return best


def _in_reach(catalogue: Catalogue, camera: Camera, radius_px: Array, area: Area) -> Catalogue:
    """The craters that the camera may see and whose size fits these sightings."""
    low, high = area.altitude_m
    view = np.hypot(camera.width_px, camera.height_px) / 2 / camera.fx_px * high
    near = np.linalg.norm(catalogue.centre_m[:, :2] - area.centre_m, axis=1) < area.reach_m + view
    least, most = radius_px.min() * low / camera.fx_px, radius_px.max() * high / camera.fx_px
    factor = np.exp(_TEST_SIZE)
    sized = (catalogue.radius_m > least / factor) & (catalogue.radius_m < most * factor)
    return catalogue.part(np.flatnonzero(near & sized))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Ordered pairs of circles in a plane."""

    index: Array
    """First and second circle (n, 2)."""
    separation: Array
    """Logarithms of the separations (n,)."""
    sizes: Array
    """Logarithms of both radii, divided by the separation (n, 2)."""
    direction: Array
    """Directions from the first to the second (n,), radians."""

    @classmethod
    def of(cls, place: Array, size: Array, least: float, most: float) -> "_Pairs":
        """All ordered pairs whose separation is between two limits."""
        index = KDTree(place).query_pairs(most, output_type="ndarray")
        index = np.concatenate([index, index[:, ::-1]])
        across = place[index[:, 1]] - place[index[:, 0]]
        separation = np.linalg.norm(across, axis=1)
        kept = separation > least
        index, across, separation = index[kept], across[kept], separation[kept]
        direction = np.arctan2(across[:, 1], across[:, 0])
        return cls(index, np.log(separation), np.log(size[index] / separation[:, None]), direction)

    def part(self, chosen: Chosen) -> "_Pairs":
        """Some of the pairs."""
        return _Pairs(self.index[chosen], self.separation[chosen], self.sizes[chosen], self.direction[chosen])

    def places(self, log_range: float, heading_rad: float) -> Array:
        """Points (n, 5), one for each pair; distances between points are in standard deviations.

        `_SIGMAS` standard deviations correspond to a difference of `log_range` in the logarithm of the separation, and
        to a difference of `heading_rad` in direction.
        """
        on_circle = np.column_stack([np.cos(self.direction), np.sin(self.direction)])
        across = 2 * np.sin(min(heading_rad, np.pi) / 2)
        ranged = self.separation[:, None] * _SIGMAS / (log_range + 0.01)
        return np.concatenate([self.sizes / _SIZE_SIGMA, ranged, on_circle * _SIGMAS / across], axis=1)


@dataclass(frozen=True, slots=True)
class _Placements:
    """Possible positions and headings of a level camera."""

    altitude_m: Array
    """Altitudes above the ground (n,), metres."""
    heading_rad: Array
    """Headings (n,), radians, relative to the heading of the assumed attitude."""
    position_m: Array
    """Positions over ground (n, 2), metres, O_L."""

    def part(self, chosen: Chosen | slice) -> "_Placements":
        """Some of the placements."""
        return _Placements(self.altitude_m[chosen], self.heading_rad[chosen], self.position_m[chosen])

    def on_ground(self, offset: Array) -> Array:
        """Points (n, M, 2), O_L, of sightings with offsets (M, 2) on the plane at depth 1."""
        turned = _turned(offset[None], self.heading_rad[:, None])
        return self.position_m[:, None] + self.altitude_m[:, None, None] * turned


def _placements(offset: Array, size: Array, local: Catalogue, camera: Camera, area: Area) -> _Placements:
    """The placements under which a pair of sightings fits a pair of catalogue craters."""
    none = _Placements(np.zeros(0), np.zeros(0), np.zeros((0, 2)))
    low, high = area.altitude_m
    width = camera.width_px / camera.fx_px
    sighting_pairs = _Pairs.of(offset, size, _MIN_SEPARATION * width, 2 * width)
    sighting_pairs = sighting_pairs.part(sighting_pairs.index[:, 0] < sighting_pairs.index[:, 1])
    if not len(sighting_pairs.index):
        return none
    most = np.exp(sighting_pairs.separation.max()) * high
    catalogue_pairs = _Pairs.of(local.centre_m[:, :2], local.radius_m, _MIN_SEPARATION * width * low, most)
    if not len(catalogue_pairs.index):
        return none
    # Scale the sightings to the middle altitude. The error of a separation is then at most half of the altitude range.
    middle = replace(sighting_pairs, separation=sighting_pairs.separation + np.log(low * high) / 2)
    log_range = np.log(high / low) / 2
    tree = KDTree(catalogue_pairs.places(log_range, area.heading_rad))
    distance, second = tree.query(middle.places(log_range, area.heading_rad), _MAX_HITS, distance_upper_bound=_FARTHEST)
    first, hit = np.nonzero(np.isfinite(distance))
    second = second[first, hit]
    if not len(first):
        return none
    heading = (catalogue_pairs.direction[second] - sighting_pairs.direction[first] + np.pi) % (2 * np.pi) - np.pi
    altitude = np.exp(catalogue_pairs.separation[second] - sighting_pairs.separation[first])
    middle_seen = offset[sighting_pairs.index[first]].mean(axis=1)
    middle_known = local.centre_m[catalogue_pairs.index[second], :2].mean(axis=1)
    position = middle_known - altitude[:, None] * _turned(middle_seen, heading)
    near = np.linalg.norm(position - area.centre_m, axis=1) <= area.reach_m
    return _Placements(altitude, heading, position).part(near)


def _agreed(placements: _Placements, offset: Array, size: Array, local: Catalogue, camera: Camera) -> Array:
    """Number of sightings (n,) that agree with a crater under each placement."""
    scale = placements.altitude_m
    altitude = float(np.exp(np.log(scale).mean()))
    per_log = _TEST_PX / _TEST_SIZE * altitude / camera.fx_px
    tree = KDTree(np.column_stack([local.centre_m[:, :2], per_log * np.log(local.radius_m)]))
    count = np.zeros(len(scale), int)
    for start in range(0, len(scale), 2000):
        batch = slice(start, start + 2000)
        ground = placements.part(batch).on_ground(offset)
        sizes = per_log * np.log(scale[batch, None] * size[None])
        points = np.concatenate([ground, sizes[..., None]], axis=2).reshape(-1, 3)
        limit = _TEST_PX * altitude / camera.fx_px
        distance, _ = tree.query(points, distance_upper_bound=limit)
        count[batch] = np.isfinite(distance).reshape(len(ground), -1).sum(axis=1)
    return count


def _turned(vector: Array, angle: Array) -> Array:
    """Vectors (..., 2) turned by angles (...)."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
