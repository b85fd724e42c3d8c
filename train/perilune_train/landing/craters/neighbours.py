"""Neighbours among points of a plane, found with a grid (compiled by numba)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.frames import Array
from perilune_train.compiled import compiled


class Grid(NamedTuple):
    """N points in a grid of n x n cells, with about as many cells as points."""

    points: Array
    """The points (N, 2)."""
    n: int
    """Number of rows, equal to the number of columns."""
    corner: Array
    """Smallest coordinates (2,)."""
    side: Array
    """Side lengths of a cell (2,)."""
    begin: NDArray[np.int64]
    """Index (n^2 + 1,) in `order` of the first point of each cell, row by row; the last element is the number of
    points."""
    order: NDArray[np.int64]
    """Indices of the points, sorted by cell (N,)."""


@compiled
def grid_of(points: Array) -> Grid:
    """Sort points (N, 2) into a grid."""
    n = int(np.ceil(np.sqrt(max(len(points), 1))))
    corner, side = np.zeros(2), np.ones(2)
    if len(points):
        for axis in range(2):
            corner[axis] = points[:, axis].min()
            side[axis] = max((points[:, axis].max() - corner[axis]) / n, 1e-9)
    cell, begin = np.empty(len(points), np.int64), np.zeros(n * n + 1, np.int64)
    for k in range(len(points)):
        row, column = _cell(points[k, 1], corner[1], side[1], n), _cell(points[k, 0], corner[0], side[0], n)
        cell[k] = row * n + column
        begin[cell[k] + 1] += 1
    begin = np.cumsum(begin)
    following, order = begin.copy(), np.empty(len(points), np.int64)
    for k in range(len(points)):
        order[following[cell[k]]] = k
        following[cell[k]] += 1
    return Grid(points, n, corner, side, begin, order)


@compiled
def _cell(coordinate: float, corner: float, side: float, n: int) -> int:
    """Index along one axis of the cell that contains a coordinate, or of the nearest cell of the grid."""
    return int(min(max((coordinate - corner) / side, 0.0), n - 1.0))


@compiled
def within_reach(positions: Array, reach: Array, others: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each of M positions (M, 2), the points (N, 2) within `reach` (M,) along each axis.

    Returns two arrays. The first (M + 1,) holds the index of the first pair of each position, and as its last element
    the number of pairs. The second holds the point of each pair.
    """
    grid = grid_of(others)
    first, other, count = np.zeros(len(positions) + 1, np.int64), np.empty(8 * len(positions) + 1, np.int64), 0
    for i in range(len(positions)):
        left = _cell(positions[i, 0] - reach[i], grid.corner[0], grid.side[0], grid.n)
        right = _cell(positions[i, 0] + reach[i], grid.corner[0], grid.side[0], grid.n)
        top = _cell(positions[i, 1] - reach[i], grid.corner[1], grid.side[1], grid.n)
        bottom = _cell(positions[i, 1] + reach[i], grid.corner[1], grid.side[1], grid.n)
        for row in range(top, bottom + 1):
            for k in range(grid.begin[row * grid.n + left], grid.begin[row * grid.n + right + 1]):
                j = grid.order[k]
                if abs(positions[i, 0] - others[j, 0]) <= reach[i] and abs(positions[i, 1] - others[j, 1]) <= reach[i]:
                    if count == len(other):
                        other = np.append(other, other)
                    other[count] = j
                    count += 1
        first[i + 1] = count
    return first, other[:count]


@compiled
def nearest(grid: Grid, x: float, y: float, count: int) -> NDArray[np.int64]:
    """The `count` points nearest to a position, nearest first, or all points if there are fewer."""
    count = min(count, len(grid.points))
    nearest_points, squared = np.empty(count, np.int64), np.full(count, np.inf)
    column, row = _cell(x, grid.corner[0], grid.side[0], grid.n), _cell(y, grid.corner[1], grid.side[1], grid.n)
    for ring in range(grid.n):
        # Points beyond the previous ring are at least this far away.
        if count and squared[count - 1] <= ((ring - 1) * min(grid.side[0], grid.side[1])) ** 2 and ring > 0:
            break
        for down in range(max(row - ring, 0), min(row + ring, grid.n - 1) + 1):
            step = 1 if abs(down - row) == ring or ring == 0 else 2 * ring
            for right in range(column - ring, column + ring + 1, step):
                if not 0 <= right < grid.n:
                    continue
                for k in range(grid.begin[down * grid.n + right], grid.begin[down * grid.n + right + 1]):
                    j = grid.order[k]
                    apart = (grid.points[j, 0] - x) ** 2 + (grid.points[j, 1] - y) ** 2
                    if not count or apart >= squared[count - 1]:
                        continue
                    # Insert in order of distance.
                    at = count - 1
                    while at > 0 and squared[at - 1] > apart:
                        squared[at], nearest_points[at] = squared[at - 1], nearest_points[at - 1]
                        at -= 1
                    squared[at], nearest_points[at] = apart, j
    return nearest_points
