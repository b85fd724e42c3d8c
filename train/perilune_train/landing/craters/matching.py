"""Match sightings with projected craters, one to one (compiled by numba).

Steps:

1. `within_reach` (neighbours.py) lists the pairs whose centres are close enough.
2. `_best` computes the cost of each pair and drops pairs beyond the gate.
3. `assigned` chooses the one-to-one assignment with the most pairs and, among these, the least total cost.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_train.compiled import compiled
from perilune_train.landing.craters.neighbours import within_reach

_ALONE = 1e6
"""Cost of leaving a sighting without a crater. It is larger than any saving from exchanging pairs, so as many sightings
as possible are matched."""


class Circles(NamedTuple):
    """N circles in an image."""

    centre_px: Array
    """Centres (N, 2)."""
    size: Array
    """Logarithms of the radii (N,)."""
    sigma_px: Array
    """Standard deviation of each centre, per axis (N,)."""


def matched(
    seen: Circles, craters: Circles, size_variance: float, gate: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """The one-to-one assignment with the most pairs within a gate and, among these, the least total cost.

    The cost of a pair is half of the squared distance divided by the variance per axis, plus the squared difference in
    size divided by `size_variance`. The cost must be below the square of `gate`. Returns the matched sightings (K,), in
    increasing order, their craters (K,), and the differences in centre and size (K, 3), sighting minus crater.
    """
    farthest_px = np.max(craters.sigma_px, initial=0.0)
    reach_px = gate * np.sqrt(2 * (seen.sigma_px**2 + farthest_px**2))
    first, crater = within_reach(seen.centre_px, reach_px, craters.centre_px)
    return _best(seen, craters, first, crater, (size_variance, gate))


@compiled
def _best(
    seen: Circles,
    craters: Circles,
    first: NDArray[np.int64],
    crater: NDArray[np.int64],
    limits: tuple[float, float],
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """`matched` for pairs listed by `within_reach`; `limits` are `size_variance` and `gate`."""
    size_variance, gate = limits
    kept, kept_crater, cost, count = np.zeros_like(first), np.empty_like(crater), np.empty(len(crater)), 0
    for i in range(len(seen.size)):
        x, y, variance = seen.centre_px[i, 0], seen.centre_px[i, 1], seen.sigma_px[i] ** 2
        for k in range(first[i], first[i + 1]):
            j = crater[k]
            squared = (x - craters.centre_px[j, 0]) ** 2 + (y - craters.centre_px[j, 1]) ** 2
            squared /= 2 * (variance + craters.sigma_px[j] ** 2)
            squared += (seen.size[i] - craters.size[j]) ** 2 / size_variance
            kept_crater[count], cost[count] = j, squared
            count += squared < gate**2
        kept[i + 1] = count
    first, crater = kept, kept_crater
    partner = assigned(first, crater, cost, len(craters.size))
    sighting = np.flatnonzero(partner >= 0)
    partner_of = partner[sighting]
    error = np.empty((len(sighting), 3))
    error[:, :2] = seen.centre_px[sighting] - craters.centre_px[partner_of]
    error[:, 2] = seen.size[sighting] - craters.size[partner_of]
    return sighting, partner_of, error


@compiled
def assigned(first: NDArray[np.int64], crater: NDArray[np.int64], cost: Array, n_craters: int) -> NDArray[np.int64]:
    """The crater of each sighting (M,), or -1, in the best one-to-one assignment.

    The best assignment has the most pairs and, among equal numbers of pairs, the least total cost. `first`
    and `crater` list the pairs as `within_reach` does. The sightings are added one at a time, each along the shortest
    path of exchanges among the listed pairs (Crouse 2016, doi 10.1109/TAES.2016.140952). A sighting may stay unmatched
    at the cost `_ALONE`.
    """
    n = len(first) - 1
    partner, taken = np.full(n, -1), np.full(n_craters, -1)
    # Dual prices of sightings and craters keep all reduced costs at 0 or above, as Dijkstra's search requires.
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
        # Exchange partners along the path, from the end to the start.
        if end < 0:
            end, partner[alone] = partner[alone], -1
        while end >= 0:
            i = before[end]
            taken[end] = i
            end, partner[i] = partner[i], end
            if i == start:
                break
    return partner
