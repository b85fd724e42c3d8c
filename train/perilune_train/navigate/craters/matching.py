"""Match sightings with projected craters, one to one (compiled by numba)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_train.navigate.compiled import compiled

_ALONE = 1e6
"""Cost of a sighting without crater: more than any exchange of pairs saves, so that as many as possible are matched."""


class Circles(NamedTuple):
    """N circles in an image."""

    centre_px: Array
    """Centres (N, 2)."""
    size: Array
    """Logarithms of the radii (N,)."""
    sigma_px: Array
    """Standard deviations of the centres, on each axis (N,)."""


@compiled
def matched(
    seen: Circles, craters: Circles, size_variance: float, gate: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """The one-to-one assignment of most pairs within a gate and, of these, of least cost.

    The cost of a pair is half of the squared distance, by the variance of each axis, plus the square of the difference
    of the sizes by `size_variance`. It is below the square of `gate`. Returns the matched sightings (K,), in increasing
    order, their craters (K,), and the differences of centre and size (K, 3), sighting less crater.
    """
    first, crater, cost = near_pairs(seen, craters, size_variance, gate)
    partner = assigned(first, crater, cost, len(craters.size))
    own = np.flatnonzero(partner >= 0)
    other = partner[own]
    error = np.empty((len(own), 3))
    error[:, :2] = seen.centre_px[own] - craters.centre_px[other]
    error[:, 2] = seen.size[own] - craters.size[other]
    return own, other, error


@compiled
def near_pairs(
    seen: Circles, craters: Circles, size_variance: float, gate: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """All pairs within the gate, sighting by sighting; arguments as of `matched`.

    Returns the place of the first pair of each of M sightings, and the number of pairs (M + 1,), then the crater of
    each pair and its cost.
    """
    n, (seen_px, seen_size, seen_sigma_px), (crater_px, crater_size, crater_sigma_px) = len(seen.size), seen, craters
    n_cells, corner, side, begin, order = _in_cells(crater_px)
    farthest = crater_sigma_px.max() if len(crater_sigma_px) else 0.0
    first = np.zeros(n + 1, np.int64)
    crater, cost = np.empty(4 * n + 1, np.int64), np.empty(4 * n + 1)
    count = 0
    for i in range(n):
        variance = seen_sigma_px[i] ** 2
        reach = gate * np.sqrt(2 * (variance + farthest**2))
        left, right = _cells(seen_px[i, 0], reach, corner[0], side[0], n_cells)
        top, bottom = _cells(seen_px[i, 1], reach, corner[1], side[1], n_cells)
        for row in range(top, bottom + 1):
            for k in range(begin[row * n_cells + left], begin[row * n_cells + right + 1]):
                j = order[k]
                across, down = seen_px[i, 0] - crater_px[j, 0], seen_px[i, 1] - crater_px[j, 1]
                one = (across**2 + down**2) / (variance + crater_sigma_px[j] ** 2) / 2
                if one >= gate**2:
                    continue
                one += (seen_size[i] - crater_size[j]) ** 2 / size_variance
                if one < gate**2:
                    if count == len(cost):
                        crater, cost = np.append(crater, crater), np.append(cost, cost)
                    crater[count], cost[count] = j, one
                    count += 1
        first[i + 1] = count
    return first, crater[:count], cost[:count]


@compiled
def _in_cells(place: Array) -> tuple[int, Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Points (N, 2) in cells of a grid, about as many as points.

    Returns the number of rows, which is that of columns, the corner of the grid (2,), the sides of a cell (2,), the
    place of the first point of each cell in the order of cells, row by row, and the points in this order (N,).
    """
    n_cells = int(np.ceil(np.sqrt(max(len(place), 1))))
    corner, side = np.zeros(2), np.ones(2)
    if len(place):
        for axis in range(2):
            corner[axis] = place[:, axis].min()
            side[axis] = max((place[:, axis].max() - corner[axis]) / n_cells, 1e-9)
    cell = np.empty(len(place), np.int64)
    begin = np.zeros(n_cells * n_cells + 1, np.int64)
    for k in range(len(place)):
        column, _ = _cells(place[k, 0], 0.0, corner[0], side[0], n_cells)
        row, _ = _cells(place[k, 1], 0.0, corner[1], side[1], n_cells)
        cell[k] = row * n_cells + column
        begin[cell[k] + 1] += 1
    begin = np.cumsum(begin)
    following, order = begin.copy(), np.empty(len(place), np.int64)
    for k in range(len(place)):
        order[following[cell[k]]] = k
        following[cell[k]] += 1
    return n_cells, corner, side, begin, order


@compiled
def _cells(place: float, reach: float, corner: float, side: float, n_cells: int) -> tuple[int, int]:
    """First and last cell along an axis that hold points at most `reach` from a place."""
    low = int(min(max((place - reach - corner) / side, 0.0), n_cells - 1.0))
    return low, int(min(max((place + reach - corner) / side, 0.0), n_cells - 1.0))


@compiled
def assigned(first: NDArray[np.int64], crater: NDArray[np.int64], cost: Array, n_craters: int) -> NDArray[np.int64]:
    """The crater of each sighting (M,), -1 for none, in the assignment of most pairs and of these of least cost.

    Pairs as of `near_pairs`. Sighting by sighting, along the shortest path of exchanges (Crouse 2016, doi
    10.1109/TAES.2016.140952), over these pairs only. A sighting may stay alone at the cost `_ALONE`.
    """
    n = len(first) - 1
    partner, taken = np.full(n, -1), np.full(n_craters, -1)
    # Dual prices of sightings and craters.
    price, discount = np.zeros(n), np.zeros(n_craters)
    shortest, before = np.full(n_craters, np.inf), np.empty(n_craters, np.int64)
    done = np.zeros(n_craters, np.bool_)
    touched, reached = np.empty(n_craters, np.int64), np.empty(n, np.int64)
    for start in range(n):
        n_touched, n_reached = 0, 0
        length, i, end = 0.0, start, -1
        least_alone, alone = np.inf, -1
        while True:
            reached[n_reached] = i
            n_reached += 1
            if length + _ALONE - price[i] < least_alone:
                least_alone, alone = length + _ALONE - price[i], i
            for k in range(first[i], first[i + 1]):
                j = crater[k]
                if done[j]:
                    continue
                path = length + cost[k] - price[i] - discount[j]
                if path < shortest[j]:
                    if shortest[j] == np.inf:
                        touched[n_touched] = j
                        n_touched += 1
                    shortest[j], before[j] = path, i
            nearest = -1
            for k in range(n_touched):
                j = touched[k]
                if not done[j] and (nearest < 0 or shortest[j] < shortest[nearest]):
                    nearest = j
            if nearest < 0 or least_alone < shortest[nearest]:
                length = least_alone
                break
            length = shortest[nearest]
            if taken[nearest] < 0:
                end = nearest
                break
            done[nearest] = True
            i = taken[nearest]
        price[start] += length
        for k in range(1, n_reached):
            price[reached[k]] += length - shortest[partner[reached[k]]]
        for k in range(n_touched):
            j = touched[k]
            if done[j]:
                discount[j] -= length - shortest[j]
            done[j] = False
            shortest[j] = np.inf
        # Exchange partners along the path, from its end.
        if end < 0:
            end, partner[alone] = partner[alone], -1
        while end >= 0:
            i = before[end]
            taken[end] = i
            end, partner[i] = partner[i], end
            if i == start:
                break
    return partner
