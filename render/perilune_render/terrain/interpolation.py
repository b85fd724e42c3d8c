"""Interpolate a field between the vertices of the grid."""

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import Grid, place_in_ring, vertex_of_ring
from perilune_shared.geometry.frames import Array


def value_at(field: Array, grid: Grid, x_m: Array | float, y_m: Array | float) -> Array:
    """Bilinear values of a field (n_vertices,) at positions in O_L, metres, of any shape.

    Outside the grid, positions get the value of the border.
    """
    x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
    relative = np.ravel(x) - grid.centre_x_m, np.ravel(y) - grid.centre_y_m
    return _values_at(field, grid.n_half, grid.half_widths_m, *relative).reshape(x.shape)


@njit()
def _values_at(field, n_half, half_widths, x, y):
    values = np.empty(len(x))
    for k in range(len(x)):
        a, b, c, d, f, g = corners(x[k], y[k], n_half, half_widths)
        low = field[a] * (1 - f) + field[b] * f
        high = field[c] * (1 - f) + field[d] * f
        values[k] = low * (1 - g) + high * g
    return values


@njit(inline="always")
def corners(x, y, n_half, half_widths):
    """The four vertices around a position, lower two first, and two interpolation weights.

    The position is relative to the grid's centre. The first weight belongs to the second vertex of each pair, the
    second weight to the upper pair.
    """
    n = n_half
    distance = max(abs(x), abs(y))
    if distance < half_widths[0]:
        step = half_widths[0] / n
        u, v = x / step + n, y / step + n
        i, j = min(int(u), 2 * n - 1), min(int(v), 2 * n - 1)
        first = j * (2 * n + 1) + i
        return first, first + 1, first + 2 * n + 1, first + 2 * n + 2, u - i, v - j
    ring = min(np.searchsorted(half_widths, distance), len(half_widths) - 1)
    inner = max(ring - 1, 0)
    width = half_widths[ring] - half_widths[inner]
    g = min((distance - half_widths[inner]) / width, 1.0) if width > 0 else 0.0
    along = place_in_ring(x, y, n)
    position = int(along)
    return (
        vertex_of_ring(inner, position, n),
        vertex_of_ring(inner, position + 1, n),
        vertex_of_ring(ring, position, n),
        vertex_of_ring(ring, position + 1, n),
        along - position,
        g,
    )
