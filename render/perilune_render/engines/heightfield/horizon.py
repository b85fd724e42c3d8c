"""Where the ground is surely lit: points from which no ray to the Sun's disc can hit anything.

A raster lies along the Sun's azimuth. For each square, it stores the height above which a point of the ground is surely
lit. A surely lit point needs no shadow ray, and the image does not change. A point is surely lit if both hold:

- near, in the square of the point and the next squares towards the Sun: no facet rises towards the Sun as steeply as
  the lowest ray to the disc, and no boulder touches the cells, so the ray's height above the ground never decreases;
- far, in the squares beyond: their highest points are below the lowest ray to the disc.
"""

from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.surface import WITHOUT_COUNTS, Ground, vertex_index, vertex_xy
from perilune_render.provenance.kernels import njit
from perilune_shared.geometry.frames import Array

_MAX_SQUARES = 2048
"""Largest number of squares along an axis."""
_CELLS = 4
"""Smallest width of a square, in cells of the inner square of the ground."""
_NEAR = 4
"""Number of squares that count as near."""
_WIDEST = 0.2
"""Largest tangent of half the disc's range of azimuths. Up to this tangent, rays to the disc deviate by less than one
square to each side over the near squares."""
_MARGIN = 1e-3
"""Margin of slopes for rounding errors of the rays."""
_MARGIN_M = 0.01
"""Margin of heights, metres."""


class Horizon(NamedTuple):
    """The raster, as an argument of compiled functions. Positions are relative to the grid's centre."""

    clear_m: np.ndarray
    """Height above which ground is surely lit, metres, infinite where it may be dark (N, N) float32. The first index
    counts squares towards the Sun, the second counts squares to the left of this direction."""
    along_x: float
    """x of the horizontal unit vector towards the Sun."""
    along_y: float
    """y of this vector."""
    edge_m: float
    """Distance from the grid's centre to the raster's edges, metres."""
    per_m: float
    """Number of squares per metre."""


NOWHERE = Horizon(np.full((1, 1), np.inf, np.float32), 1.0, 0.0, 0.0, 1.0)
"""A horizon that marks no point as surely lit."""


def horizon_of(ground: Ground, sun: Array, disc_rad: float) -> Horizon:
    """The horizon of a ground for a Sun of angular radius `disc_rad` in the direction `sun` (3,), O_L.

    Takes about a second for ten million vertices. Returns `NOWHERE` for a Sun at the zenith or at the horizon.
    """
    elevation, level = np.arcsin(sun[2]), float(np.hypot(sun[0], sun[1]))
    radius = 1.001 * disc_rad + 1e-6
    lowest = float(np.tan(elevation - radius))
    if lowest <= _MARGIN or np.sin(radius) >= level:
        return NOWHERE
    turn = float(np.arcsin(np.sin(radius) / level))
    if np.tan(turn) > _WIDEST:
        return NOWHERE
    along_x, along_y = float(sun[0]) / level, float(sun[1]) / level
    edge_m = float(ground.half_widths_m[-1]) * (abs(along_x) + abs(along_y)) + 1.0
    pitch_m = max(2 * edge_m / _MAX_SQUARES, _CELLS * float(ground.half_widths_m[0]) / ground.n_half)
    n = int(np.ceil(2 * edge_m / pitch_m))
    empty = Horizon(np.full((n, n), -np.inf, np.float32), along_x, along_y, edge_m, 1 / pitch_m)
    steep = np.zeros((n, n), np.bool_)
    _fill(ground, empty, lowest - _MARGIN, float(np.sin(turn)), steep)
    highest, steep = _widened(empty.clear_m), _widened(steep)
    near = steep.copy()
    for k in range(1, _NEAR):
        near[:-k] |= steep[k:]
    # After k squares, a ray has risen by at least the rise over k - 1 squares.
    rise, every = np.float32(lowest * pitch_m), int(0.75 / max(np.tan(turn), 1e-6))
    clear = np.full((n, n), -np.inf, np.float32)
    for row in range(n - 2, -1, -1):
        clear[row] = np.maximum(highest[row + 1], clear[row + 1] - rise)
        if row % every == 0:
            # Over `every` squares, the disc's range of azimuths widens by less than one square on each side.
            clear[row] = _widened(clear[row : row + 1])[0]
    far = np.full((n, n), -np.inf, np.float32)
    far[: 1 - _NEAR] = clear[_NEAR - 1 :] - rise * np.float32(_NEAR - 1)
    return empty._replace(clear_m=np.where(near, np.float32(np.inf), far + np.float32(_MARGIN_M)))


def _widened(raster: np.ndarray) -> np.ndarray:
    """The largest value (N, M) of each square and its two neighbours across the Sun's azimuth."""
    widened = raster.copy()
    widened[:, 1:] = np.maximum(widened[:, 1:], raster[:, :-1])
    widened[:, :-1] = np.maximum(widened[:, :-1], raster[:, 1:])
    return widened


@njit(**WITHOUT_COUNTS)
def _fill(ground, raster, steepest, turned, steep):
    """Write the largest height of each square into `raster.clear_m`, and mark rough squares in `steep`.

    A square is rough if it touches a cell with a boulder or a steep facet. A facet is steep if its slope is larger than
    `steepest` along any direction near the Sun's azimuth; `turned` is the sine of the largest angle to the azimuth.
    """
    n = ground.n_half
    for part in range(5):
        for row in range(2 * n if part == 0 else len(ground.half_widths_m) - 1):
            for column in range(2 * n):
                _add_cell(ground, raster, (part, row, column), steepest, turned, steep)


@njit(**WITHOUT_COUNTS)
def _add_cell(ground, raster, cell, steepest, turned, steep):
    """Add one cell to all squares that its bounding box touches; see `_fill`.

    The sides of the box are along and across the Sun's azimuth.
    """
    (part, row, column), n, half, highest = cell, ground.n_half, ground.half_widths_m, raster.clear_m
    v0, v1 = vertex_index(part, row, column, 0, n), vertex_index(part, row, column, 1, n)
    v2, v3 = vertex_index(part, row, column, 2, n), vertex_index(part, row, column, 3, n)
    x0, y0 = vertex_xy(part, row, column, 0, n, half)
    x1, y1 = vertex_xy(part, row, column, 1, n, half)
    x2, y2 = vertex_xy(part, row, column, 2, n, half)
    x3, y3 = vertex_xy(part, row, column, 3, n, half)
    a0, b0 = x0 * raster.along_x + y0 * raster.along_y, y0 * raster.along_x - x0 * raster.along_y
    a1, b1 = x1 * raster.along_x + y1 * raster.along_y, y1 * raster.along_x - x1 * raster.along_y
    a2, b2 = x2 * raster.along_x + y2 * raster.along_y, y2 * raster.along_x - x2 * raster.along_y
    a3, b3 = x3 * raster.along_x + y3 * raster.along_y, y3 * raster.along_x - x3 * raster.along_y
    z0, z1 = float(ground.vertex[v0, 2]), float(ground.vertex[v1, 2])
    z2, z3 = float(ground.vertex[v2, 2]), float(ground.vertex[v3, 2])
    top = max(max(z0, z1), max(z2, z3))
    edge_1, edge_2, edge_3 = (a1 - a0, b1 - b0, z1 - z0), (a2 - a0, b2 - b0, z2 - z0), (a3 - a0, b3 - b0, z3 - z0)
    against = _against(edge_1, edge_2, turned)
    against = max(against, _against(edge_2, edge_3, turned))
    rough = against > steepest
    if ground.vertex[v0, 3] < 0:
        # The first level of the pyramid also includes the boulders' tops.
        sizes = (2 * n, 2 * n) if part == 0 else (len(half) - 1, 2 * n)
        n_rows, n_columns = (sizes[0] + 1) >> 1, (sizes[1] + 1) >> 1
        block = (max(part - 1, 0) * n_rows + (row >> 1)) * n_columns + (column >> 1)
        top = float(ground.top_m[ground.level[min(part, 1), 1] + block])
        rough = True
    last = highest.shape[0] - 1
    scale, edge = raster.per_m, raster.edge_m
    i_low = max(int((min(min(a0, a1), min(a2, a3)) + edge) * scale - 1e-6), 0)
    i_high = min(int((max(max(a0, a1), max(a2, a3)) + edge) * scale + 1e-6), last)
    j_low = max(int((min(min(b0, b1), min(b2, b3)) + edge) * scale - 1e-6), 0)
    j_high = min(int((max(max(b0, b1), max(b2, b3)) + edge) * scale + 1e-6), last)
    for i in range(i_low, i_high + 1):
        for j in range(j_low, j_high + 1):
            highest[i, j] = max(highest[i, j], np.float32(top))
            steep[i, j] = steep[i, j] or rough


@njit(inline="always", **WITHOUT_COUNTS)
def _against(first, second, turned):
    """Upper bound on a triangle's slope along directions near the axis a, from two edges (a, b, z)."""
    (a1, b1, z1), (a2, b2, z2) = first, second
    area = a1 * b2 - a2 * b1
    slope_a, slope_b = (z1 * b2 - z2 * b1) / area, (a1 * z2 - a2 * z1) / area
    return slope_a + turned * (abs(slope_a) + abs(slope_b))


@njit(inline="always", **WITHOUT_COUNTS)
def surely_lit(horizon, x, y, z):
    """Whether it is certain that no ray from a point of the ground to the Sun's disc hits anything."""
    i = int((x * horizon.along_x + y * horizon.along_y + horizon.edge_m) * horizon.per_m)
    j = int((y * horizon.along_x - x * horizon.along_y + horizon.edge_m) * horizon.per_m)
    n = horizon.clear_m.shape[0]
    return 0 <= i < n and 0 <= j < n and z > horizon.clear_m[i, j]
