"""Search for a pose near an expected pose, by votes of pairs of sightings.

A pair of neighbouring sightings and a pair of craters of fitting sizes give an altitude, a heading and a place: the
ratio and the angle between the two separations, and the point that the middle of the image then shows. Each such match
is a vote. Correct matches vote for one pose, and all other matches spread over the whole range. As the altitude and the
heading follow from each vote, one pass over the craters searches all altitudes and headings (compiled by numba).

A vote has the likelihood of two sightings, so a few hundred pairs suffice. Pairs vote in rounds of increasing size
until one pose stands out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.neighbours import grid_of
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.craters.vote import Candidate, SearchRange

_NEAR_PX, _FAR_PX, _PARTNERS = 16.0, 60.0, 4
"""Smallest and largest distance of two sightings of a pair, and largest number of nearest partners of a sighting. Pairs
that are closer leave altitude and heading uncertain; for pairs that are farther apart, more wrong craters fit."""
_ROUNDS = (40, 70, 100, 140, 200, 300, 450, 700, 1000, 1500, 2400)
"""Numbers of pairs that have voted at the ends of the rounds."""
_SIZE_TOLERANCE = 0.27
"""Largest difference of the logarithms of the radii of a sighting and its crater."""
_SMALL_SHARE = 0.01
"""Share of the craters of a catalogue that may be smaller than the sightings that vote. Near the ground, most sightings
are smaller than the smallest crater of a catalogue."""
_BIN_PX, _LAYER = 3.0, 0.03
"""Side of a bin, pixels at the expected altitude, and its height, as a share of the altitude. Votes are summed over
three by three by three bins."""
_MAX_BINS = 1_000_000
"""Approximate largest number of bins. Bins grow to respect it."""
_SURE, _SURELY_AHEAD = 30.0, 2.0
"""Voting ends at a peak with this significance that is this many times as significant as the next. On validation
scenes with the true pose outside the range, wrong poses reach 11."""
_N_CANDIDATES = 8
"""Largest number of candidates."""
_HEADING_RAD = 0.02
"""Votes of a peak whose headings differ by less than this are averaged."""
_MAX_VOTES = 3_000_000
"""Largest number of kept votes, which limits the memory."""
_MAX_VISITED = 5_000_000
"""Largest number of visits of a second crater in a round, which limits the time if a catalogue is unusually dense. No
round follows."""
_LIMITS = _SIZE_TOLERANCE, _MAX_VISITED


class _Ground(NamedTuple):
    """N craters in the plane, sorted by the cells of a grid (see neighbours.py)."""

    xy_m: Array
    """Centres (N, 2), metres, from the point that the middle of the image shows from the expected pose."""
    height_m: Array
    """Heights above the ground (N,), metres."""
    radius_m: Array
    """Radii (N,), metres."""
    by_radius: NDArray[np.int64]
    """Indices of the craters by increasing radius (N,)."""
    begin: NDArray[np.int64]
    """Index of the first crater of each cell (n^2 + 1,)."""
    n: int
    """Number of rows and columns of cells."""
    corner: Array
    """Smallest coordinates (2,)."""
    side: Array
    """Side lengths of a cell (2,)."""


class _Bins(NamedTuple):
    """Bins of the votes, and limits of the search."""

    low_m: float
    """Smallest altitude, metres."""
    high_m: float
    """Largest altitude, metres."""
    heading_rad: float
    """Largest difference in heading."""
    reach_m: float
    """Largest shift along each axis, metres."""
    bin_m: float
    """Side of a bin, metres."""
    layer: float
    """Height of a bin, logarithm of the altitude."""
    n_layers: int
    """Number of bins along the altitude."""
    n_sides: int
    """Number of bins on each side of zero along each horizontal axis."""


def pair_candidates(
    sightings: Sightings, catalogue: Catalogue, camera: Camera, expected: Pose, limits: SearchRange, max_tried: int
) -> tuple[list[Candidate], bool]:
    """The poses with the most significant peaks of votes of pairs, most significant first; whether the first is sure.

    All poses have the tilt of `expected`. Only the first pose is returned if it is sure. No round begins after
    `max_tried` trials of a crater for the first sighting of a pair, which limits the time.
    """
    if not len(catalogue):
        return [], False
    altitude_m = float(expected.position_m[2]) - limits.ground_m
    bins = _bins(limits, altitude_m, camera)
    least_px = np.quantile(catalogue.radius_m, _SMALL_SHARE) * camera.fx_px / bins.high_m * np.exp(-_SIZE_TOLERANCE)
    sightings = sightings.part(sightings.radius_px >= least_px)
    middle_px = np.array([[camera.width_px / 2, camera.height_px / 2]])
    rays = camera.rays(np.concatenate([sightings.centre_px, middle_px])) @ expected.rotation_camera_from_site
    if not (rays[:, 2] < 0).all():
        return [], False
    on_plane = -rays[:, :2] / rays[:, 2:]
    ray, middle = np.ascontiguousarray(on_plane[:-1] - on_plane[-1]), on_plane[-1]
    radius = sightings.radius_px / camera.fx_px
    pairs = _neighbours(sightings.centre_px, _NEAR_PX, _FAR_PX, _PARTNERS)
    pairs = pairs[np.random.default_rng(0).permutation(len(pairs))]
    origin_m = expected.position_m[:2] + altitude_m * middle
    smallest_m = float(radius.min(initial=1.0)) * bins.low_m * np.exp(-_SIZE_TOLERANCE)
    view_m = float(np.abs(ray).max(initial=0.0)) * bins.high_m
    ground = _ground(catalogue, origin_m, limits.ground_m, (bins.reach_m + 1.1 * view_m, smallest_m))
    width = 2 * bins.n_sides + 1
    votes = np.zeros(bins.n_layers * width * width, np.uint16)
    kept = (np.zeros((0, 4), np.float32), np.zeros(0, np.int64))
    hot, first, n_tried = np.zeros(0, np.int64), 0, 0
    peaks: list[tuple[float, int]] = []
    is_sure = False
    for last in _ROUNDS:
        new, cell, crossing, tried = _vote(
            ray, radius, pairs[first:last], ground, bins, (_SIZE_TOLERANCE, _MAX_VISITED), votes
        )
        kept = np.concatenate([kept[0], new]), np.concatenate([kept[1], cell])
        hot, n_tried, first = np.concatenate([hot, crossing]), n_tried + tried, last
        peaks = _peaks(votes, hot, len(kept[0]), bins)
        is_sure = bool(peaks) and peaks[0][0] >= max(_SURE, _SURELY_AHEAD * (peaks[1][0] if len(peaks) > 1 else 0.0))
        if is_sure or last >= len(pairs) or n_tried > max_tried or len(kept[0]) > _MAX_VOTES:
            break
    found = []
    for significance, peak in peaks[:1] if is_sure else peaks:
        x_m, y_m, height_m, heading = _average(kept[0], kept[1], peak, width, _HEADING_RAD)
        turn = matrix_from_rotation_vector(np.array([0.0, 0.0, heading]))
        shift = height_m * (turn[:2, :2] @ middle)
        position_m = np.array([origin_m[0] + x_m - shift[0], origin_m[1] + y_m - shift[1], limits.ground_m + height_m])
        found.append(Candidate(Pose(position_m, expected.rotation_camera_from_site @ turn.T), significance))
    return found, is_sure


def _bins(limits: SearchRange, altitude_m: float, camera: Camera) -> _Bins:
    """Bins that cover a range and respect `_MAX_BINS`."""
    low, high = limits.log_altitude
    n_layers = max(int(np.ceil((high - low) / _LAYER)), 1)
    reach_m = float(np.hypot(limits.shift_m, limits.shift_px * altitude_m / camera.fx_px))
    # At least 1.5 px: a range of no width has one bin on each side.
    least_m = 2 * reach_m * np.sqrt(n_layers / _MAX_BINS)
    bin_m = max(_BIN_PX * altitude_m / camera.fx_px, least_m)
    n_sides = max(int(np.ceil(reach_m / bin_m)), 1)
    low_m, high_m = altitude_m * float(np.exp(low)), altitude_m * float(np.exp(high))
    return _Bins(low_m, high_m, limits.heading_rad, reach_m, bin_m, (high - low) / n_layers, n_layers, n_sides)


def _ground(catalogue: Catalogue, origin_m: Array, ground_m: float, limits: tuple[float, float]) -> _Ground:
    """The craters within a distance along each axis and with at least a radius, metres; `limits` are both."""
    near = np.abs(catalogue.centre_m[:, :2] - origin_m).max(axis=1, initial=0.0) <= limits[0]
    chosen = np.flatnonzero(near & (catalogue.radius_m >= limits[1]))
    grid = grid_of(catalogue.centre_m[chosen, :2] - origin_m)
    chosen = chosen[grid.order]
    radius_m = catalogue.radius_m[chosen]
    height_m = catalogue.centre_m[chosen, 2] - ground_m
    by_radius = np.argsort(radius_m)
    return _Ground(
        grid.points[grid.order], height_m, radius_m, by_radius, grid.begin, grid.n, grid.corner, grid.side
    )  # fmt: skip


@compiled
def _neighbours(centre_px: Array, near_px: float, far_px: float, count: int) -> NDArray[np.int64]:
    """Pairs (P, 2) of each of M points (M, 2) and its nearest partners between two distances, each pair once."""
    n = len(centre_px)
    partner, apart = np.full((n, count), -1), np.full((n, count), far_px**2)
    for i in range(n):
        for j in range(n):
            squared = (centre_px[i, 0] - centre_px[j, 0]) ** 2 + (centre_px[i, 1] - centre_px[j, 1]) ** 2
            if squared < near_px**2 or squared >= apart[i, count - 1]:
                continue
            place = count - 1
            while place > 0 and apart[i, place - 1] > squared:
                apart[i, place], partner[i, place] = apart[i, place - 1], partner[i, place - 1]
                place -= 1
            apart[i, place], partner[i, place] = squared, j
    pairs, n_pairs = np.empty((n * count, 2), np.int64), 0
    for i in range(n):
        for j in partner[i]:
            if j < 0 or (j < i and (partner[j] == i).any()):
                continue
            pairs[n_pairs, 0], pairs[n_pairs, 1] = min(i, j), max(i, j)
            n_pairs += 1
    return pairs[:n_pairs]


@compiled
def _clipped(coordinate: float, corner: float, side: float, n: int) -> int:
    """Index along one axis of the cell that contains a coordinate, or of the nearest cell of the grid."""
    return int(min(max((coordinate - corner) / side, 0.0), n - 1.0))


@compiled
def _vote(
    ray: Array,
    radius: Array,
    pairs: NDArray[np.int64],
    ground: _Ground,
    bins: _Bins,
    limits: tuple[float, int],
    votes: NDArray[np.uint16],
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64], int]:
    """Let pairs (P, 2) vote; add their votes to `votes`.

    `ray` (M, 2) are the sightings on the plane at depth 1 in the axes of O_L, relative to the middle of the image, and
    `radius` (M,) their radii there. Returns the votes (V, 4) as place (x, y), altitude and heading, the bins of the
    votes (V,), the bins whose number of votes has reached two, and the number of craters tried, or a very large number
    if too many second craters were visited. `limits` are the largest difference of the logarithms of two radii, and the
    number of visited second craters at which voting ends.
    """
    size_tolerance, max_visited = limits
    factor, tangent = np.exp(size_tolerance), np.tan(min(bins.heading_rad, 1.5))
    cos, sin = np.cos(bins.heading_rad), np.sin(bins.heading_rad)
    width = 2 * bins.n_sides + 1
    xy, begin, corner, side, n = ground.xy_m, ground.begin, ground.corner, ground.side, ground.n
    sizes = ground.radius_m[ground.by_radius]
    kept, cell, count = np.empty((4096, 4), np.float32), np.empty(4096, np.int64), 0
    hot, n_hot, tried, visited = np.empty(4096, np.int64), 0, 0, 0
    for p in range(len(pairs)):
        i, j = pairs[p]
        across, up = ray[j, 0] - ray[i, 0], ray[j, 1] - ray[i, 1]
        squared = across**2 + up**2
        middle_x, middle_y = (ray[i, 0] + ray[j, 0]) / 2, (ray[i, 1] + ray[j, 1]) / 2
        # The separation turned by the largest difference in heading to either side.
        left_x, left_y = cos * across - sin * up, sin * across + cos * up
        right_x, right_y = cos * across + sin * up, cos * up - sin * across
        far = abs(ray[i, 0]) + abs(ray[i, 1])
        first = np.searchsorted(sizes, radius[i] * bins.low_m / factor)
        last = np.searchsorted(sizes, radius[i] * bins.high_m * factor)
        if visited > max_visited:
            break
        for k in range(first, last):
            if visited > max_visited:
                break
            a = ground.by_radius[k]
            x, y = xy[a]
            # The size of the crater limits the altitude.
            by_size_m = ground.radius_m[a] / radius[i]
            low_m, high_m = max(bins.low_m, by_size_m / factor), min(bins.high_m, by_size_m * factor)
            mean_m = (low_m + high_m) / 2
            slack_m = bins.reach_m + ((high_m - low_m) / 2 + mean_m * tangent) * far
            if abs(x - mean_m * ray[i, 0]) > slack_m or abs(y - mean_m * ray[i, 1]) > slack_m:
                continue
            tried += 1
            least_x = min(low_m * left_x, high_m * left_x, low_m * right_x, high_m * right_x)
            most_x = max(low_m * left_x, high_m * left_x, low_m * right_x, high_m * right_x)
            least_y = min(low_m * left_y, high_m * left_y, low_m * right_y, high_m * right_y)
            most_y = max(low_m * left_y, high_m * left_y, low_m * right_y, high_m * right_y)
            west, east = _clipped(x + least_x, corner[0], side[0], n), _clipped(x + most_x, corner[0], side[0], n)
            south, north = _clipped(y + least_y, corner[1], side[1], n), _clipped(y + most_y, corner[1], side[1], n)
            for row in range(south, north + 1):
                visited += begin[row * n + east + 1] - begin[row * n + west]
                for b in range(begin[row * n + west], begin[row * n + east + 1]):
                    step_x, step_y = xy[b, 0] - x, xy[b, 1] - y
                    # The quotient of both separations, as complex numbers: altitude and heading.
                    real = (step_x * across + step_y * up) / squared
                    imaginary = (step_y * across - step_x * up) / squared
                    if abs(imaginary) > tangent * real:
                        continue
                    depth_m = np.sqrt(real**2 + imaginary**2)
                    if depth_m < low_m or depth_m > high_m:
                        continue
                    expected_m = radius[j] * depth_m
                    if ground.radius_m[b] > factor * expected_m or ground.radius_m[b] * factor < expected_m:
                        continue
                    place_x = (x + xy[b, 0]) / 2 - (real * middle_x - imaginary * middle_y)
                    place_y = (y + xy[b, 1]) / 2 - (imaginary * middle_x + real * middle_y)
                    column = int(np.floor(place_x / bins.bin_m + bins.n_sides + 0.5))
                    line = int(np.floor(place_y / bins.bin_m + bins.n_sides + 0.5))
                    altitude_m = depth_m + (ground.height_m[a] + ground.height_m[b]) / 2
                    if not (0 <= column < width and 0 <= line < width and altitude_m > 0):
                        continue
                    layer = int(np.floor(np.log(altitude_m / bins.low_m) / bins.layer))
                    if not 0 <= layer < bins.n_layers:
                        continue
                    place = (layer * width + line) * width + column
                    votes[place] += 1
                    if count == len(cell):
                        cell, kept = np.append(cell, cell), np.concatenate((kept, kept))
                    cell[count] = place
                    kept[count, 0], kept[count, 1], kept[count, 2] = place_x, place_y, altitude_m
                    kept[count, 3] = np.arctan2(imaginary, real)
                    count += 1
                    if votes[place] == 2:
                        if n_hot == len(hot):
                            hot = np.append(hot, hot)
                        hot[n_hot] = place
                        n_hot += 1
    return kept[:count], cell[:count], hot[:n_hot], tried if visited <= max_visited else 1 << 60


def _peaks(votes: NDArray[np.uint16], hot: NDArray[np.int64], n_votes: int, bins: _Bins) -> list[tuple[float, int]]:
    """Significance and bin of the most significant peaks, most significant first."""
    width = 2 * bins.n_sides + 1
    significance = _significance(votes, hot, bins.n_layers, width)
    best: list[tuple[float, int]] = []
    for index in np.argsort(-significance, kind="stable"):
        place = int(hot[index])
        if significance[index] <= 0 or len(best) == _N_CANDIDATES:
            break
        layer, line, column = place // width**2, place // width % width, place % width
        if all(
            max(abs(layer - other // width**2) - 2, abs(line - other // width % width), abs(column - other % width)) > 2
            for _, other in best
        ):
            best.append((float(significance[index]), place))
    return best


@compiled
def _significance(votes: NDArray[np.uint16], hot: NDArray[np.int64], n_layers: int, width: int) -> Array:
    """Logarithms of the likelihood ratios (K,) between the votes around K bins and chance, by Poisson's law.

    The logarithm of the number of windows is subtracted.
    """
    in_layer = np.zeros(n_layers + 2)
    for layer in range(n_layers):
        for place in range(layer * width * width, (layer + 1) * width * width):
            in_layer[layer + 1] += votes[place]
    significance = np.empty(len(hot))
    for index in range(len(hot)):
        layer, line, column = hot[index] // width**2, hot[index] // width % width, hot[index] % width
        count = 0
        for z in range(max(layer - 1, 0), min(layer + 2, n_layers)):
            for y in range(max(line - 1, 0), min(line + 2, width)):
                for x in range(max(column - 1, 0), min(column + 2, width)):
                    count += votes[(z * width + y) * width + x]
        expected = max((in_layer[layer] + in_layer[layer + 1] + in_layer[layer + 2]) * 9.0 / width**2, 0.5)
        significance[index] = -np.log(max(n_layers * width**2 / 27.0, 1.0))
        if count > expected:
            significance[index] += count * np.log(count / expected) - (count - expected)
    return significance


@compiled
def _average(
    kept: NDArray[np.float32], cell: NDArray[np.int64], peak: int, width: int, near_rad: float
) -> tuple[float, float, float, float]:
    """Place (x, y), altitude and heading of a peak: the mean of its votes with the most frequent heading."""
    layer, line, column = peak // width**2, peak // width % width, peak % width
    chosen, count = np.empty(len(cell), np.int64), 0
    for index in range(len(cell)):
        is_near = abs(cell[index] // width**2 - layer) <= 1 and abs(cell[index] // width % width - line) <= 1
        if is_near and abs(cell[index] % width - column) <= 1:
            chosen[count] = index
            count += 1
    best, most = 0, 0
    for first in range(count):
        n_near = 0
        for second in range(count):
            n_near += abs(kept[chosen[first], 3] - kept[chosen[second], 3]) < near_rad
        if n_near > most:
            best, most = chosen[first], n_near
    total = np.zeros(4)
    for k in range(count):
        if abs(kept[chosen[k], 3] - kept[best, 3]) < near_rad:
            for part in range(4):
                total[part] += kept[chosen[k], part]
    return total[0] / most, total[1] / most, total[2] / most, total[3] / most
