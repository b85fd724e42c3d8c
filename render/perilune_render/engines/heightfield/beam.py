"""Find where the rays of a block of pixels may begin, and the part of the mesh that they hit.

A raster of squares stores the largest height of the ground and its boulders in each square. The squares of the next
coarser level of the raster are twice as wide. The search follows the rays of a block downwards, layer by layer. If the
ground and the boulders under a layer do not reach up into it, no ray ends in it. All rays of the block can then begin
below the layers in which no ray ends.
"""

from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, Ground, vertex_xy
from perilune_render.provenance.kernels import njit

BLOCK_PX = 4
"""Width and height of the blocks of pixels."""
_SQUARES = 1024
"""Number of squares along an axis of the finest level, a power of two."""
_LEVEL = 2
"""Level of the pyramid `Ground.top_m` from which the raster is built."""
_LAYERS = 16
"""Largest number of layers that the search tries."""
_THINNEST_M = 0.5
"""The search ends when a layer is thinner than this, metres."""
_MIN_FALL = -1e-3
"""A ray falls if its vertical component is at most this value, with component 1 along the camera's axis."""
_MARGIN_M = 0.01
"""Margin of heights and positions for rounding errors of the rays, metres."""


class Tops(NamedTuple):
    """The raster, as an argument of compiled functions. Positions are relative to the grid's centre."""

    top_m: np.ndarray
    """Largest height in each square, metres, float32; -inf without ground. The levels follow each other from the
    finest; the squares of a level are ordered by y, then x."""
    edge_m: float
    """Distance from the grid's centre to the raster's edges, metres."""
    per_m: float
    """Number of squares of the finest level per metre."""


def tops_of(ground: Ground) -> Tops:
    """The raster of a ground. Takes some hundredths of a second for ten million vertices."""
    edge_m = float(ground.half_widths_m[-1])
    level = np.full((_SQUARES, _SQUARES), -np.inf, np.float32)
    _fill(ground, level, edge_m, _SQUARES / (2 * edge_m))
    levels = [level.ravel()]
    while len(level) > 1:
        level = level.reshape(len(level) // 2, 2, -1, 2).max(axis=(1, 3))
        levels.append(level.ravel())
    return Tops(np.concatenate(levels), edge_m, _SQUARES / (2 * edge_m))


@njit(**WITHOUT_COUNTS)
def _fill(ground, raster, edge, scale):
    """Write the largest height in each square, from the blocks of a level of the ground's pyramid."""
    n, n_rings = ground.n_half, len(ground.half_widths_m) - 1
    for part in range(5):
        kind = min(part, 1)
        level = min(_LEVEL, ground.level[kind, -1])
        rows, columns = 2 * n if part == 0 else n_rings, 2 * n
        n_rows, n_columns = (rows + (1 << level) - 1) >> level, (columns + (1 << level) - 1) >> level
        first = ground.level[kind, level] + max(part - 1, 0) * n_rows * n_columns
        for row in range(n_rows):
            for column in range(n_columns):
                low_row, last_row = row << level, min((row + 1) << level, rows) - 1
                low_column, last_column = column << level, min((column + 1) << level, columns) - 1
                x0, x1, y0, y1 = np.inf, -np.inf, np.inf, -np.inf
                for k in range(4):
                    for i in (low_row, last_row):
                        for j in (low_column, last_column):
                            x, y = vertex_xy(part, i, j, k, n, ground.half_widths_m)
                            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
                top = ground.top_m[first + row * n_columns + column]
                i0, i1, j0, j1 = _squares(x0, x1, y0, y1, edge, scale)
                for j in range(j0, j1 + 1):
                    for i in range(i0, i1 + 1):
                        raster[j, i] = max(raster[j, i], top)


@njit(**INLINED)
def _squares(x0, x1, y0, y1, edge, scale):
    """First and last column and first and last row of the squares that a rectangle touches."""
    last = _SQUARES - 1
    i0, i1 = int(np.floor((x0 + edge) * scale - 1e-6)), int(np.floor((x1 + edge) * scale + 1e-6))
    j0, j1 = int(np.floor((y0 + edge) * scale - 1e-6)), int(np.floor((y1 + edge) * scale + 1e-6))
    return min(max(i0, 0), last), min(max(i1, 0), last), min(max(j0, 0), last), min(max(j1, 0), last)


@njit(**WITHOUT_COUNTS)
def _highest(tops, x0, x1, y0, y1):
    """Largest height below a rectangle, from the finest level of which it touches at most 4 x 4 squares."""
    i0, i1, j0, j1 = _squares(x0, x1, y0, y1, tops.edge_m, tops.per_m)
    level = 0
    while max((i1 >> level) - (i0 >> level), (j1 >> level) - (j0 >> level)) > 3:
        level += 1
    width = _SQUARES >> level
    first = (_SQUARES * _SQUARES - width * width) * 4 // 3
    highest = -np.inf
    for j in range(j0 >> level, (j1 >> level) + 1):
        for i in range(i0 >> level, (i1 >> level) + 1):
            highest = max(highest, float(tops.top_m[first + j * width + i]))
    return highest


@njit(**WITHOUT_COUNTS)
def begin_m(tops, ground, origin, basis, rectangle):
    """Height at which the rays through a rectangle of the image may begin, metres.

    Above this height, no ray through the rectangle (u0, u1, v0, v1), pixels, hits anything. The height is inf if not
    all rays fall. The ray at image coordinates (u, v) is u basis[0] + v basis[1] + basis[2].
    """
    u0, u1, v0, v1 = rectangle
    x_low, x_high, y_low, y_high = np.inf, -np.inf, np.inf, -np.inf
    for k in range(4):
        u, v = u0 if k & 1 == 0 else u1, v0 if k & 2 == 0 else v1
        dz = u * basis[0, 2] + v * basis[1, 2] + basis[2, 2]
        if dz > _MIN_FALL:
            return np.inf
        # Horizontal distance that the ray covers per metre of height.
        x = (u * basis[0, 0] + v * basis[1, 0] + basis[2, 0]) / dz
        y = (u * basis[0, 1] + v * basis[1, 1] + basis[2, 1]) / dz
        x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
    z = min(ground.highest_m, origin[2])
    layer = (z - ground.lowest_m) / 4
    for _ in range(_LAYERS):
        if layer < _THINNEST_M:
            break
        # top and bottom are negative, so the largest ratio gives the smallest coordinate.
        top, bottom = z - origin[2], z - layer - origin[2]
        x0, x1 = min(top * x_high, bottom * x_high), max(top * x_low, bottom * x_low)
        y0, y1 = min(top * y_high, bottom * y_high), max(top * y_low, bottom * y_low)
        highest = _highest(tops, origin[0] + x0, origin[0] + x1, origin[1] + y0, origin[1] + y1)
        if highest < z - layer:
            z -= layer
        else:
            z, layer = min(z, highest), layer / 2
    return z + _MARGIN_M


@njit(**WITHOUT_COUNTS)
def only_part(ground, origin, basis, rectangle, begin):
    """The part of the mesh in which all rays through a rectangle of the image stay.

    The rays are followed from the height `begin`, metres, down to the lowest ground. 0 is the inner square, 1 to 4 are
    the sectors. The result is -1 if the rays cross several parts, or if not all rays fall. The other arguments are as
    in `begin_m`.
    """
    u0, u1, v0, v1 = rectangle
    if begin > min(ground.highest_m, origin[2]):
        return -1
    x_low, x_high, y_low, y_high = np.inf, -np.inf, np.inf, -np.inf
    for k in range(4):
        u, v = u0 if k & 1 == 0 else u1, v0 if k & 2 == 0 else v1
        dz = u * basis[0, 2] + v * basis[1, 2] + basis[2, 2]
        if dz > _MIN_FALL:
            return -1
        for height in (begin - origin[2], ground.lowest_m - origin[2]):
            x = origin[0] + height * ((u * basis[0, 0] + v * basis[1, 0] + basis[2, 0]) / dz)
            y = origin[1] + height * ((u * basis[0, 1] + v * basis[1, 1] + basis[2, 1]) / dz)
            x_low, x_high, y_low, y_high = min(x_low, x), max(x_high, x), min(y_low, y), max(y_high, y)
    x_low, x_high, y_low, y_high = x_low - _MARGIN_M, x_high + _MARGIN_M, y_low - _MARGIN_M, y_high + _MARGIN_M
    half, outer = ground.half_widths_m[0], ground.half_widths_m[-1]
    x_far, y_far = max(-x_low, x_high), max(-y_low, y_high)
    if max(x_far, y_far) < half:
        return 0
    if max(x_far, y_far) < outer:
        if -y_high > max(half, x_far):
            return 1
        if x_low > max(half, y_far):
            return 2
        if y_low > max(half, x_far):
            return 3
        if -x_high > max(half, y_far):
            return 4
    return -1
