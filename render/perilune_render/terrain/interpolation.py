"""Values of a field between the vertices of the grid."""

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import Grid, place_in_ring, vertex_of_ring
from perilune_shared.geometry.frames import Array


def value_at(field: Array, grid: Grid, x_m: Array | float, y_m: Array | float) -> Array:
    """Values of a field (n_vertices,) at places of any shape, interpolated bilinearly; outside, the border's value."""
    x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
    relative = np.ravel(x) - grid.centre_x_m, np.ravel(y) - grid.centre_y_m
    return _values_at(field, grid.n_half, grid.half_widths_m, *relative).reshape(x.shape)


@njit()
def _values_at(field, n_half, half_widths, x, y):
    n = n_half
    step = half_widths[0] / n
    values = np.empty(len(x))
    for k in range(len(x)):
        distance = max(abs(x[k]), abs(y[k]))
        if distance < half_widths[0]:
            u, v = x[k] / step + n, y[k] / step + n
            i, j = min(int(u), 2 * n - 1), min(int(v), 2 * n - 1)
            f, g = u - i, v - j
            first = j * (2 * n + 1) + i
            low = field[first] * (1 - f) + field[first + 1] * f
            high = field[first + 2 * n + 1] * (1 - f) + field[first + 2 * n + 2] * f
            values[k] = low * (1 - g) + high * g
            continue
        ring = min(np.searchsorted(half_widths, distance), len(half_widths) - 1)
        inner = max(ring - 1, 0)
        width = half_widths[ring] - half_widths[inner]
        g = min((distance - half_widths[inner]) / width, 1.0) if width > 0 else 0.0
        along = place_in_ring(x[k], y[k], n)
        place = int(along)
        f = along - place
        low = field[vertex_of_ring(inner, place, n)] * (1 - f) + field[vertex_of_ring(inner, place + 1, n)] * f
        high = field[vertex_of_ring(ring, place, n)] * (1 - f) + field[vertex_of_ring(ring, place + 1, n)] * f
        values[k] = low * (1 - g) + high * g
    return values
