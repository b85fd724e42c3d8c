"""Search for a pose over a whole catalogue, by votes of pairs of a sighting and a crater.

An error of the expected pose shifts, scales and turns the image of the catalogue. For each altitude and heading of a
grid, every pair of similar size votes for the shift that maps its crater onto its sighting. The correct pairs vote for
one shift, and all other pairs spread over the whole range. The search does not depend on any single crater, so it also
works where the largest sightings have no counterpart in the catalogue.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings

_BIN_PX, _STEP = 1.5, 0.03
"""Size of a bin, pixels; step of the heading, radians, and of the logarithm of the altitude. Half a step moves the
corner of a frame of 256 px by 2.7 px. Votes are summed over windows of three by three bins, 4.5 px wide."""
_MAX_BINS = 400
"""Largest number of bins on each side of zero. Bins grow up to twice their size to respect it; searches over even
larger shifts exceed it."""
_MAX_SHIFT_PX = 2000.0
"""Larger shifts are not searched. This limits memory and time if the expected altitude is wrong."""
_SIZE_TOLERANCE = 0.35
"""Largest difference of the logarithms of the radii of a pair that votes."""
_MAX_WINDOWS = 1.5e9
"""Approximate largest number of windows in a search, over all altitudes and headings; it takes a few seconds."""
_MIN_VOTERS = 120
"""Smallest number of sightings that vote. If there are fewer, all vote."""
_REFINED_SHIFT_PX, _REFINED_LOG_ALTITUDE, _REFINED_HEADING_RAD = 15.0, 0.06, 0.07
"""Range of the second vote around a candidate."""
_BORDER_PX = 40.0
"""Craters that are farther outside the image do not take part in the second vote."""
_SURE_SIGNIFICANCE = 36.0
"""A candidate with at least this significance in the second vote is taken as the true pose. On validation scenes, wrong
poses reach 11."""
_APART_PX = 6.0
"""Candidates at one altitude and heading are at least this far apart."""


@dataclass(frozen=True, slots=True)
class Effort:
    """How thorough a search is."""

    coarser: float
    """Factor that enlarges bins and steps."""
    max_pairs: int
    """Largest number of pairs of all voting sightings together; sightings of the rarest sizes vote first."""
    n_candidates: int
    """Largest number of candidates."""
    max_votes: float = 4e8
    """Largest number of votes over all altitudes and headings. In a search over a large range, fewer sightings vote."""


LOST, LOST_FINELY = Effort(2.0, 3_000_000, 64, 2e9), Effort(1.0, 3_000_000, 16, 8e9)
"""Efforts of the two searches: the first search takes seconds. If it finds nothing, the second search takes up
to half a minute."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose for which sightings have voted."""

    pose: Pose
    """The pose."""
    significance: float
    """Logarithm of the likelihood ratio between the number of votes and chance, less the logarithm of the number of
    windows searched."""


@dataclass(frozen=True, slots=True)
class SearchRange:
    """Limits of a search: height of the ground, and largest errors of the expected pose."""

    ground_m: float
    """Height of the ground below the expected pose, metres, O_L."""
    shift_m: float
    """Horizontal displacement along each axis, metres."""
    shift_px: float
    """Further shift of the image along each axis, pixels, for example by a tilt."""
    log_altitude: tuple[float, float]
    """Smallest and largest logarithm of the altitude divided by the expected altitude."""
    heading_rad: float
    """Difference in heading, radians; pi if the heading is unknown."""


def candidates(
    sightings: Sightings,
    catalogue: Catalogue,
    camera: Camera,
    expected: Pose,
    limits: SearchRange,
    effort: Effort,
) -> list[Candidate]:
    """The poses with the most significant peaks of votes, most significant first.

    The shift of the image is converted to a horizontal displacement of the camera. All poses have the tilt of
    `expected`.
    """
    low, high = limits.log_altitude
    altitude_m = float(expected.position_m[2]) - limits.ground_m
    coarser = effort.coarser * _coarser_for(limits, altitude_m, camera, effort.coarser)
    step = coarser * _STEP
    log_altitudes = np.linspace(low, high, 1 + int(np.ceil((high - low) / step)))
    n_headings = 1 + 2 * int(np.ceil(limits.heading_rad / step))
    headings = np.linspace(-limits.heading_rad, limits.heading_rad, n_headings)
    size = np.log(sightings.radius_px)
    smallest_px = float(np.exp(size.min() - _SIZE_TOLERANCE)) if len(size) else 1.0
    peaks: list[tuple[float, float, float, float, float]] = []
    for log_altitude in log_altitudes:
        higher = altitude_m * (np.exp(log_altitude) - 1)
        range_px = _range_px(limits, altitude_m + higher, camera)
        bin_px = _BIN_PX * max(float(np.clip(range_px / _BIN_PX / _MAX_BINS, 1.0, 2.0)), coarser)
        reach = max(1, int(np.ceil(range_px / bin_px)))
        pose = Pose(expected.position_m + np.array([0.0, 0.0, higher]), expected.rotation_camera_from_site)
        view = projected(catalogue, camera, pose, range_px, smallest_px)
        order = np.argsort(view.radius_px)
        known_size = np.log(view.radius_px[order])
        first = np.searchsorted(known_size, size - _SIZE_TOLERANCE)
        last = np.searchsorted(known_size, size + _SIZE_TOLERANCE)
        voters = _rarest(last - first, effort.max_pairs, effort.max_votes / (len(log_altitudes) * len(headings)))
        middle = np.array([camera.cx_px, camera.cy_px])
        shifts = _peaks(
            sightings.centre_px[voters] - middle,
            view.centre_px[order] - middle,
            first[voters],
            last[voters],
            headings,
            (bin_px, reach),
        )
        peaks += [
            (significance, log_altitude, heading, right, down) for significance, heading, right, down in shifts.tolist()
        ]
    best: list[tuple[float, float, float, float, float]] = []
    for peak in sorted(peaks, reverse=True):
        if all(_differ(peak, better, 2.5 * step) for better in best):
            best.append(peak)
        if len(best) == effort.n_candidates:
            break
    return [Candidate(_pose_of(peak, expected, altitude_m, camera), peak[0]) for peak in best]


def refined(sightings: Sightings, catalogue: Catalogue, camera: Camera, coarse: list[Candidate]) -> list[Candidate]:
    """Let all sightings vote again near each candidate, with fine bins; most significant poses first.

    In a wide search, the peak of the true pose is spread over several coarse bins, and the many bins make high peaks by
    chance likely. The second vote multiplies the significance of the true pose and hardly changes the significance of
    wrong poses. It stops at the first candidate with `_SURE_SIGNIFICANCE`.
    """
    again: list[Candidate] = []
    log_altitude = (-_REFINED_LOG_ALTITUDE, _REFINED_LOG_ALTITUDE)
    for candidate in coarse:
        pose = candidate.pose
        limits = SearchRange(
            catalogue.ground_m(pose.position_m, _NEAREST), 0.0, _REFINED_SHIFT_PX, log_altitude, _REFINED_HEADING_RAD
        )
        in_image = projected(catalogue, camera, pose, _BORDER_PX, 0.0).index
        again += candidates(sightings, catalogue.part(in_image), camera, pose, limits, _REFINED)
        if again and again[-1].significance >= _SURE_SIGNIFICANCE:
            break
    return sorted(again, key=lambda candidate: -candidate.significance)


_REFINED = Effort(1.0, 3_000_000, 1)
_NEAREST = 30
"""Number of nearest craters whose median height is taken as the height of the ground."""


def _range_px(limits: SearchRange, altitude_m: float, camera: Camera) -> float:
    """Largest shift of the image along each axis at an altitude, pixels."""
    return min(float(np.hypot(limits.shift_m / altitude_m * camera.fx_px, limits.shift_px)), _MAX_SHIFT_PX)


def _coarser_for(limits: SearchRange, altitude_m: float, camera: Camera, coarser: float) -> float:
    """Factor, at least 1, by which bins and steps grow to keep a search below `_MAX_WINDOWS` windows.

    The factor reduces the steps of altitude, heading and both shifts, so the number of windows falls with its fourth
    power.
    """
    low, high = limits.log_altitude
    step, bin_px = coarser * _STEP, coarser * _BIN_PX
    reach_px = _range_px(limits, altitude_m * float(np.exp(low)), camera)
    n_slices = (1 + (high - low) / step) * (1 + 2 * limits.heading_rad / step)
    return max(n_slices * (1 + 2 * reach_px / bin_px) ** 2 / _MAX_WINDOWS, 1.0) ** 0.25


def _rarest(n_pairs: NDArray[np.integer], max_pairs: int, limit: float) -> NDArray[np.integer]:
    """Indices of the sightings that vote, rarest sizes first.

    `n_pairs` (M,) is the number of craters of similar size of each sighting. The chosen sightings have at most
    `max_pairs` pairs in total, but at least `_MIN_VOTERS` vote unless these have more than `limit` pairs.
    """
    order = np.argsort(n_pairs, kind="stable")
    pairs = np.cumsum(n_pairs[order])
    enough = max(int(np.searchsorted(pairs, max_pairs, side="right")), _MIN_VOTERS)
    return order[: min(enough, int(np.searchsorted(pairs, limit, side="right")))]


@compiled
def _peaks(
    seen_px: Array,
    known_px: Array,
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    headings: Array,
    grid: tuple[float, int],
) -> Array:
    """The two best peaks (2 H, 4) at each of H headings.

    The columns are significance, heading, and shift to the right and down, pixels. `seen_px` (M, 2) and `known_px`
    (N, 2) are relative to the principal point. Sighting i forms pairs with the craters from `first[i]` to
    `last[i] - 1`. `grid` holds the size of a bin and the number of bins on each side of zero.
    """
    bin_px, reach = grid
    side = 2 * reach + 1
    peaks = np.zeros((2 * len(headings), 4))
    # Small integers keep the votes in the processor's cache.
    votes = np.empty((side, side), np.uint16)
    three = np.zeros(side + 2, np.int64)
    turned = np.empty_like(known_px)
    for h in range(len(headings)):
        cos, sin = np.cos(headings[h]), np.sin(headings[h])
        for j in range(len(known_px)):
            turned[j, 0] = cos * known_px[j, 0] - sin * known_px[j, 1]
            turned[j, 1] = sin * known_px[j, 0] + cos * known_px[j, 1]
        votes[:] = 0
        n_votes = 0
        for i in range(len(seen_px)):
            for j in range(first[i], last[i]):
                column = int(np.floor((seen_px[i, 0] - turned[j, 0]) / bin_px + reach + 0.5))
                row = int(np.floor((seen_px[i, 1] - turned[j, 1]) / bin_px + reach + 0.5))
                if 0 <= column < side and 0 <= row < side:
                    votes[row, column] += 1
                    n_votes += 1
        expected = max(9.0 * n_votes / side**2, 0.5)
        best, best_row, best_column = -1, 0, 0
        second, second_row, second_column = -1, 0, 0
        squares = 0.0
        for row in range(side):
            above, below = max(row - 1, 0), min(row + 1, side - 1)
            for column in range(side):
                three[column + 1] = votes[row, column]
                if above < row:
                    three[column + 1] += votes[above, column]
                if below > row:
                    three[column + 1] += votes[below, column]
            for column in range(side):
                count = three[column] + three[column + 1] + three[column + 2]
                squares += count * count
                if count <= second or votes[row, column] == 0:
                    continue
                is_apart = max(abs(row - best_row), abs(column - best_column)) > 3
                if count > best:
                    if is_apart:
                        second, second_row, second_column = best, best_row, best_column
                    best, best_row, best_column = count, row, column
                elif is_apart:
                    second, second_row, second_column = count, row, column
        # Leave out the largest peak, because it may be the true pose.
        for row in range(max(best_row - 3, 0), min(best_row + 4, side)):
            for column in range(max(best_column - 3, 0), min(best_column + 4, side)):
                count = 0
                for r in range(max(row - 1, 0), min(row + 2, side)):
                    for c in range(max(column - 1, 0), min(column + 2, side)):
                        count += votes[r, c]
                squares -= count * count
        # Groups of craters, and sightings of one crater at two scales, make the votes cluster: divide by the ratio
        # between the variance of the windows and the variance by Poisson's law.
        clustering = max((squares / side**2 - expected**2) / expected, 1.0)
        for k in range(2):
            count, row, column = (best, best_row, best_column) if k == 0 else (second, second_row, second_column)
            # Logarithm of the likelihood ratio between this count and chance, by Poisson's law. The logarithm of the
            # number of windows is subtracted, because by chance the maximum over more windows is larger.
            likelihood = count * np.log(max(count, 1.0) / expected) - (count - expected)
            peaks[2 * h + k, 0] = likelihood / clustering - np.log(side**2 / 9.0)
            peaks[2 * h + k, 1] = headings[h]
            peaks[2 * h + k, 2] = (column - reach) * bin_px
            peaks[2 * h + k, 3] = (row - reach) * bin_px
    return peaks


def _differ(first: tuple[float, ...], second: tuple[float, ...], near: float) -> bool:
    """Whether two peaks are far enough apart to be different poses."""
    turn = (first[2] - second[2] + np.pi) % (2 * np.pi) - np.pi
    shift_px = max(abs(first[3] - second[3]), abs(first[4] - second[4]))
    return shift_px > _APART_PX or abs(first[1] - second[1]) > near or abs(turn) > near


def _pose_of(peak: tuple[float, ...], expected: Pose, altitude_m: float, camera: Camera) -> Pose:
    """The pose of a peak: altitude, then heading about the optical axis, then a horizontal displacement."""
    _, log_altitude, heading, right, down = peak
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rotation = turn @ expected.rotation_camera_from_site
    scaled_m = altitude_m * np.exp(log_altitude)
    # The image moves opposite to the camera.
    across = np.array([-right / camera.fx_px, -down / camera.fy_px, 0.0]) * scaled_m
    position = expected.position_m + np.array([0.0, 0.0, scaled_m - altitude_m])
    shift = rotation.T @ across
    return Pose(position + shift * [1.0, 1.0, 0.0], rotation)


@dataclass(frozen=True, slots=True)
class Support:
    """How many sightings agree with a pose, and how many would agree by chance."""

    n_agreed: int
    """Number of sightings near a crater of similar size."""
    n_by_chance: float
    """Mean of this number for displaced images of the catalogue."""
    sigma_by_chance: float
    """Standard deviation of this number for displaced images, at least 1."""

    @property
    def excess(self) -> float:
        """Number of agreeing sightings beyond chance."""
        return self.n_agreed - self.n_by_chance

    @property
    def sigmas(self) -> float:
        """Excess in standard deviations of chance."""
        return self.excess / self.sigma_by_chance


_DISPLACED = np.array(
    [
        [radius * np.cos(angle), radius * np.sin(angle)]
        for radius, phase in ((9.0, 0.0), (14.0, 0.4), (21.0, 0.8))
        for angle in phase + np.arange(8) * np.pi / 4
    ]
)
"""Displacements (24, 2), pixels, of the projected catalogue. At these, sightings agree with craters by chance only."""
_AGREE_SIGMAS, _AGREE_SIZE = 2.5, 0.35
"""Largest distance, in standard deviations, and largest difference of the logarithms of the radii of a sighting and a
crater that agree."""


def support(sightings: Sightings, catalogue: Catalogue, camera: Camera, pose: Pose) -> Support:
    """Count the sightings that agree with a pose, and those that agree by chance near it."""
    if not len(sightings):
        return Support(0, 0.0, 1.0)
    size = np.log(sightings.radius_px)
    view = projected(catalogue, camera, pose, 30.0, float(np.exp(size.min() - _AGREE_SIZE)))
    if not len(view.index):
        return Support(0, 0.0, 1.0)
    placed_px = camera.fx_px / float(np.median(view.depth_m)) * catalogue.position_sigma_m
    reach_px = _AGREE_SIGMAS * np.sqrt(sightings.noise_px**2 + sightings.static_px**2 + placed_px**2)
    order = np.argsort(view.centre_px[:, 0])
    counts = _agreed(
        sightings.centre_px,
        size,
        reach_px,
        view.centre_px[order],
        np.log(view.radius_px[order]),
        np.concatenate([np.zeros((1, 2)), _DISPLACED]),
        _AGREE_SIZE,
    )
    mean = float(counts[1:].mean())
    return Support(int(counts[0]), mean, float(max(counts[1:].std(), np.sqrt(mean), 1.0)))


@compiled
def _agreed(
    seen_px: Array,
    seen_size: Array,
    reach_px: Array,
    known_px: Array,
    known_size: Array,
    displaced: Array,
    size_tolerance: float,
) -> NDArray[np.int64]:
    """Number of sightings (D,) with a crater of similar size within reach, for D displacements (D, 2).

    The displacements are added to the craters. The craters are sorted by their first coordinate.
    """
    counts = np.zeros(len(displaced), np.int64)
    for d in range(len(displaced)):
        for i in range(len(seen_px)):
            x, y = seen_px[i, 0] - displaced[d, 0], seen_px[i, 1] - displaced[d, 1]
            j = np.searchsorted(known_px[:, 0], x - reach_px[i])
            while j < len(known_px) and known_px[j, 0] <= x + reach_px[i]:
                apart = (known_px[j, 0] - x) ** 2 + (known_px[j, 1] - y) ** 2
                if apart <= reach_px[i] ** 2 and abs(known_size[j] - seen_size[i]) <= size_tolerance:
                    counts[d] += 1
                    break
                j += 1
    return counts
