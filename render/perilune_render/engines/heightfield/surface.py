"""The ground as arrays for casting rays: heights, normals, albedo, and a pyramid of largest heights.

Blender renders the same mesh: `Grid.quads`, each quad split from its first to its third vertex. The mesh has two kinds
of parts:

- the inner square, a regular grid;
- four sectors around it, one for each side (y = -d, then x = d, y = d, x = -d). In a sector, a point has two
  coordinates: d, its distance max(|x|, |y|) from the centre, and `along`, its coordinate along the side. Rings are the
  lines d = half_widths[r], spokes are the lines along / d = s / n_half - 1. They cross at the vertices.

A cell is a quad. Level L of the pyramid, from 1, stores the largest height in blocks of 2^L x 2^L cells, including the
boulders that touch them. The four numbers of a vertex are adjacent, since rays spend most of their time reading memory.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.rocks import Rocks, rocks_of
from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import vertex_of_ring
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array

WITHOUT_COUNTS = {"error_model": "numpy", "_nrt": False}
"""Options of kernels that create no arrays. They skip reference counts, which all threads would have to write."""
INLINED = WITHOUT_COUNTS | {"forceinline": True}
"""Options of kernels that are compiled into their callers, since a call would pass `Ground` and `Rocks` as about 70
numbers."""
_MAX_LEVELS = 16
_MARGIN_M = 0.01
"""Margin between the surface and the heights where rays begin and end, so that each ray crosses the ground."""


class Ground(NamedTuple):
    """Arrays of the ground, as an argument of compiled functions.

    There are few arrays, since each is passed as eight numbers.
    """

    half_widths_m: Array
    """Half-widths of the inner square and the rings, ascending, metres (R + 1,)."""
    vertex: np.ndarray
    """For each vertex, in the grid's order (V, 4) float32: x and y of the unit normal, O_L; height, metres; albedo,
    negative if boulders touch the cell that has this vertex as its first."""
    top_m: np.ndarray
    """Pyramids of largest heights, metres, float32: first the inner square, ordered by y and x, then the sectors,
    ordered by side, ring and spoke. Within each pyramid, the levels follow each other from level 1."""
    level: np.ndarray
    """Index in `top_m` at which each level begins, for the inner square and the sectors (2, L + 1) int64. The last
    column holds the number of the coarsest level."""
    n_half: int
    """Vertex spacings from the centre of the inner square to its border."""
    lowest_m: float
    """Height below all ground, metres."""
    highest_m: float
    """Height above all ground and boulders, metres."""
    ring: np.ndarray
    """Table of ring numbers at equal steps of the distance max(|x|, |y|), from the first ring (N,) int64."""
    rings_per_m: float
    """Number of elements of `ring` per metre."""


@dataclass(frozen=True, slots=True)
class Surface:
    """Ground and boulders of a scene."""

    ground: Ground
    """Arrays of the ground."""
    rocks: Rocks
    """Boulders, and the cells that each touches."""
    centre_m: tuple[float, float]
    """x and y of the grid's centre, O_L, metres; the arrays are relative to it."""


def surface_of(scene: Scene) -> Surface:
    """Build the surface of a scene. Takes a few seconds for ten million vertices."""
    grid, n = scene.grid, scene.grid.n_half
    half = np.ascontiguousarray(grid.half_widths_m, np.float64)
    height = np.ascontiguousarray(scene.height_m, np.float32)
    rocks, tops = rocks_of(scene)
    _raise_to_ground(height, n, *tops)
    pyramids = [_levels(tops[0][None]), _levels(tops[1])]
    starts = np.zeros((2, _MAX_LEVELS + 1), np.int64)
    for part, levels in enumerate(pyramids):
        before = 0 if part == 0 else sum(map(len, pyramids[0]))
        starts[part, 1 : len(levels) + 1] = before + np.cumsum([0, *map(len, levels)])[:-1]
        starts[part, -1] = len(levels)
    top = np.concatenate([level for levels in pyramids for level in levels])
    highest = max(float(part.max()) for part in tops if part.size)
    vertices = np.empty((len(height), 4), np.float32)
    vertices[:, 2], vertices[:, 3] = height, scene.albedo
    _write_normals(n, half, height, vertices)
    _mark_rocks(vertices, n, rocks.cell_start, len(half) - 1)
    bounds = float(height.min()) - _MARGIN_M, highest + _MARGIN_M
    ground = Ground(half, vertices, top, starts, n, *bounds, *_ring_table(half))
    return Surface(ground, rocks, (grid.centre_x_m, grid.centre_y_m))


def _ring_table(half_widths: Array) -> tuple[np.ndarray, float]:
    """`Ground.ring` and `Ground.rings_per_m`, with four elements per ring on average."""
    n_rings = len(half_widths) - 1
    width, count = half_widths[-1] - half_widths[0], 4 * max(n_rings, 1)
    steps = half_widths[0] + width / count * np.arange(count)
    ring = np.clip(np.searchsorted(half_widths, steps, side="right") - 1, 0, max(n_rings - 1, 0))
    return ring, float(count / width) if n_rings else 0.0


def _levels(tops: np.ndarray) -> list[np.ndarray]:
    """Pyramid of the largest values of `tops` (sides, rows, columns): its levels, from 1, as flat arrays."""
    levels: list[np.ndarray] = []
    level = tops
    while not levels or (max(level.shape[1:]) > 1 and len(levels) < _MAX_LEVELS - 1):
        level = _coarser(level)
        levels.append(level.ravel())
    return levels


@njit()
def _coarser(tops):
    """The largest values in blocks of 2 x 2 of `tops` (sides, rows, columns).

    If the number of rows or columns is odd, the last blocks are smaller.
    """
    n_sides, n_rows, n_columns = tops.shape
    coarse = np.full((n_sides, (n_rows + 1) // 2, (n_columns + 1) // 2), -np.inf, np.float32)
    for side in range(n_sides):
        for row in range(n_rows):
            for column in range(n_columns):
                top = coarse[side, row >> 1, column >> 1]
                coarse[side, row >> 1, column >> 1] = max(top, tops[side, row, column])
    return coarse


@njit(inline="always")
def ring_vertex(ring, index, n):
    """Like `vertex_of_ring`, for indices in the ring up to 8 n, without a division."""
    if index >= 8 * n:
        index -= 8 * n
    return (2 * n + 1) ** 2 + (ring - 1) * 8 * n + index if ring > 0 else vertex_of_ring(ring, index, n)


@njit(**INLINED)
def vertex_index(part, row, column, k, n):
    """Index of vertex k (0 to 3, as in `Grid.quads`) of a cell, in the grid's order."""
    if part == 0:
        return (row + (1 if k >= 2 else 0)) * (2 * n + 1) + column + (1 if k == 1 or k == 2 else 0)
    index = (part - 1) * 2 * n + column + (1 if k >= 2 else 0)
    return ring_vertex(row + (1 if k == 1 or k == 2 else 0), index, n)


@njit(**INLINED)
def vertex_xy(part, row, column, k, n, half_widths):
    """x and y of vertex k of a cell, relative to the grid's centre."""
    if part == 0:
        step = half_widths[0] / n
        return (column + (1 if k == 1 or k == 2 else 0) - n) * step, (row + (1 if k >= 2 else 0) - n) * step
    d = half_widths[row + (1 if k == 1 or k == 2 else 0)]
    along = d * ((column + (1 if k >= 2 else 0)) / n - 1)
    if part == 1:
        return along, -d
    if part == 2:
        return d, along
    if part == 3:
        return -along, d
    return -d, -along


@njit()
def _raise_to_ground(height, n, inner_top, sector_top):
    """Raise the top of each cell to the largest height of its four vertices."""
    for j in range(2 * n):
        for i in range(2 * n):
            for k in range(4):
                inner_top[j, i] = max(inner_top[j, i], height[vertex_index(0, j, i, k, n)])
    for side in range(4):
        for ring in range(sector_top.shape[1]):
            for t in range(2 * n):
                for k in range(4):
                    top = height[vertex_index(side + 1, ring, t, k, n)]
                    sector_top[side, ring, t] = max(sector_top[side, ring, t], top)


@njit()
def _add_face(cell, n, half_widths, height, points, total):
    """Add the normal of a cell to `total` (V, 3) at each vertex, weighted by the angle there.

    `cell` is (part, row, column); `points` (4, 3) is overwritten.
    """
    part, row, column = cell
    for k in range(4):
        points[k, 0], points[k, 1] = vertex_xy(part, row, column, k, n, half_widths)
        points[k, 2] = height[vertex_index(part, row, column, k, n)]
    ax, ay, az = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    bx, by, bz = points[3, 0] - points[1, 0], points[3, 1] - points[1, 1], points[3, 2] - points[1, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    for k in range(4):
        after, before = (k + 1) % 4, (k + 3) % 4
        ux, uy, uz = points[after, 0] - points[k, 0], points[after, 1] - points[k, 1], points[after, 2] - points[k, 2]
        vx, vy, vz = (
            points[before, 0] - points[k, 0],
            points[before, 1] - points[k, 1],
            points[before, 2] - points[k, 2],
        )
        sides = np.sqrt((ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz))
        angle = np.arccos(min(max((ux * vx + uy * vy + uz * vz) / sides, -1.0), 1.0)) / length
        at = vertex_index(part, row, column, k, n)
        total[at, 0] += angle * nx
        total[at, 1] += angle * ny
        total[at, 2] += angle * nz


@njit()
def _write_normals(n, half_widths, height, vertices):
    """Write x and y of the unit vertex normals: as in Blender, means of face normals, weighted by angles."""
    total, points = np.zeros((len(height), 3)), np.empty((4, 3))
    for j in range(2 * n):
        for i in range(2 * n):
            _add_face((0, j, i), n, half_widths, height, points, total)
    for side in range(4):
        for ring in range(len(half_widths) - 1):
            for t in range(2 * n):
                _add_face((side + 1, ring, t), n, half_widths, height, points, total)
    for k in range(len(height)):
        length = np.sqrt(total[k, 0] ** 2 + total[k, 1] ** 2 + total[k, 2] ** 2)
        vertices[k, 0], vertices[k, 1] = total[k, 0] / length, total[k, 1] / length


@njit()
def _mark_rocks(vertices, n, cell_start, n_rings):
    """Make the albedo of the first vertex of each cell with boulders negative."""
    for cell in range(len(cell_start) - 1):
        if cell_start[cell] < cell_start[cell + 1]:
            if cell < 4 * n * n:
                at = vertex_index(0, cell // (2 * n), cell % (2 * n), 0, n)
            else:
                row, spoke = divmod(cell - 4 * n * n, 2 * n)
                at = vertex_index(row // n_rings + 1, row % n_rings, spoke, 0, n)
            vertices[at, 3] = -abs(vertices[at, 3])
