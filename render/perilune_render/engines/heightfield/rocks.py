"""Boulders for casting rays: convex rocks as half-spaces, and the boulders in each ground cell."""

from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.boulders import FULL_SPACINGS, N_FEW_POINTS, N_POINTS, rock
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array, matrix_from_quaternion


class Rocks(NamedTuple):
    """N boulders, as arguments of compiled functions. Positions are relative to the grid's centre."""

    rows: Array
    """For each boulder (N, 15): centre, metres (3); matrix rotation_rock_from_site divided by the diameter, 1 / metre
    (9); radius of the enclosing sphere, metres; index of its first face in `planes`, and index after its last face."""
    planes: Array
    """Outer unit normal and distance from the centre of each face, for a rock of diameter 1 (F, 4)."""
    cell_start: np.ndarray
    """Index in `cell_rock` of each cell's first boulder (C + 1,) int64; the last element is the length of `cell_rock`.
    The cells of the inner square come first, ordered by y and x, then the cells of the sectors, ordered by side, ring
    and spoke."""
    cell_rock: np.ndarray
    """Indices of the boulders in each cell (M,) int64."""


def rocks_of(scene: Scene) -> tuple[Rocks, tuple[np.ndarray, np.ndarray]]:
    """The boulders of a scene, with the shapes of `perilune_render.terrain.boulders.boulder_mesh`.

    The second result is the height of the highest boulder in each cell of the inner square (2 n, 2 n) and of the
    sectors (4, R, 2 n), metres, float32, -inf without boulders.
    """
    boulders, grid = scene.boulders, scene.grid
    local = grid.spacing_under(boulders.x_m, boulders.y_m)
    full = boulders.diameter_m >= FULL_SPACINGS * local
    kinds, shape = np.unique(2 * boulders.shape_id + full, return_inverse=True)
    shape = shape.ravel()
    planes, reach, starts = [np.empty((0, 4))], [], [0]
    for kind in kinds.tolist():
        solid = rock(kind // 2, scene.seed, N_POINTS if kind % 2 else N_FEW_POINTS)
        offset = np.einsum("ij,ij->i", solid.face_normals, solid.triangles[:, 0])
        planes.append(np.concatenate([solid.face_normals, offset[:, None]], axis=1))
        reach.append(float(np.linalg.norm(solid.vertices, axis=1).max()))
        starts.append(starts[-1] + len(offset))
    rows = np.empty((len(boulders), 15))
    rows[:, 0], rows[:, 1] = boulders.x_m - grid.centre_x_m, boulders.y_m - grid.centre_y_m
    rows[:, 2] = scene.boulder_z_m
    rotation = matrix_from_quaternion(boulders.rotation_wxyz.reshape(-1, 4)).transpose(0, 2, 1)
    rows[:, 3:12] = (rotation / boulders.diameter_m[:, None, None]).reshape(-1, 9)
    rows[:, 12] = boulders.diameter_m * np.array([*reach, 0.0])[shape]
    rows[:, 13], rows[:, 14] = np.array([*starts, 0])[shape], np.array([*starts, 0])[shape + 1]
    starts_of_cells, numbers, *tops = cells_of_rocks(rows, grid.n_half, grid.half_widths_m)
    return Rocks(rows, np.concatenate(planes), starts_of_cells, numbers), (tops[0], tops[1])


def cells_of_rocks(
    rows: Array, n_half: int, half_widths_m: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The boulders in each cell, for boulders with these `Rocks.rows`.

    Returns `Rocks.cell_start`, `Rocks.cell_rock`, and the height of the highest boulder in each cell of the inner
    square (2 n, 2 n) and of the sectors (4, R, 2 n), metres, float32.
    """
    n, n_rings = n_half, len(half_widths_m) - 1
    inner, sectors = np.full((2 * n, 2 * n), -np.inf, np.float32), np.full((4, n_rings, 2 * n), -np.inf, np.float32)
    counts = np.zeros(inner.size + sectors.size + 1, np.int64)
    nothing = np.zeros(0, np.int64)
    _fill(rows, n, half_widths_m, (inner, sectors), counts, nothing)
    starts = np.concatenate([[0], np.cumsum(counts[:-1])]).astype(np.int64)
    numbers = np.empty(int(starts[-1]), np.int64)
    _fill(rows, n, half_widths_m, (inner, sectors), starts[:-1].copy(), numbers)
    return starts, numbers, inner, sectors


@njit()
def _fill(rows, n, half_widths, tops, position, numbers):
    """Write the boulders of each cell into `numbers`, or count them if `numbers` is empty.

    `position` is the index in `numbers` of the next boulder of each cell, and is advanced. Without `numbers`, it counts
    the boulders of each cell. `tops`, the largest heights of the cells of the inner square and of the sectors, is
    raised to the highest boulder of each cell.
    """
    (inner, sectors), write = tops, len(numbers) > 0
    step = half_widths[0] / n
    n_rings = len(half_widths) - 1
    for k in range(len(rows)):
        x, y, r = rows[k, 0], rows[k, 1], rows[k, 12]
        top = rows[k, 2] + r
        i_low, i_high = int(np.floor((x - r) / step)) + n, int(np.floor((x + r) / step)) + n
        j_low, j_high = int(np.floor((y - r) / step)) + n, int(np.floor((y + r) / step)) + n
        for j in range(max(j_low, 0), min(j_high, 2 * n - 1) + 1):
            for i in range(max(i_low, 0), min(i_high, 2 * n - 1) + 1):
                inner[j, i] = max(inner[j, i], top)
                cell = j * 2 * n + i
                if write:
                    numbers[position[cell]] = k
                position[cell] += 1
        for side in range(4):
            if side == 0:
                along, d = x, -y
            elif side == 1:
                along, d = y, x
            elif side == 2:
                along, d = -x, y
            else:
                along, d = -y, -x
            near, far = max(d - r, half_widths[0]), d + r
            if far <= half_widths[0] or near >= half_widths[n_rings]:
                continue
            low = min((along - r) / near, (along - r) / far)
            high = max((along + r) / near, (along + r) / far)
            if low > 1 or high < -1:
                continue
            t_low, t_high = max(int(np.floor((low + 1) * n)), 0), min(int(np.floor((high + 1) * n)), 2 * n - 1)
            first = max(np.searchsorted(half_widths, near, side="right") - 1, 0)
            last = min(np.searchsorted(half_widths, far, side="right") - 1, n_rings - 1)
            for ring in range(first, last + 1):
                for t in range(t_low, t_high + 1):
                    sectors[side, ring, t] = max(sectors[side, ring, t], top)
                    cell = 4 * n * n + (side * n_rings + ring) * 2 * n + t
                    if write:
                        numbers[position[cell]] = k
                    position[cell] += 1
