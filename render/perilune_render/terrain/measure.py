"""Measure each crater on the finished ground: rim plane and depth."""

from dataclasses import dataclass

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.craters import Craters
from perilune_render.terrain.grid import Grid, place_in_ring, vertex_of_ring
from perilune_shared.geometry.frames import Array

_N_RIM = 16


@dataclass(frozen=True, slots=True)
class Rims:
    """Measured rims of N craters."""

    z_m: Array
    """Mean height of the rim, O_L, metres (N,)."""
    normal: Array
    """Unit normal of the plane through the rim, O_L (N, 3)."""
    depth_m: Array
    """Mean height of the rim minus that of the floor (inner fifth) and minus `Laid.sag_m`, at least 0, metres (N,)."""


def value_at(field: Array, grid: Grid, x_m: Array | float, y_m: Array | float) -> Array:
    """Values of a field (n_vertices,) at places of any shape, interpolated bilinearly; outside, the border's value."""
    x, y = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
    found = _values_at(field, grid.n_half, grid.half_widths_m, np.ravel(x), np.ravel(y))
    return found.reshape(x.shape)


def measure_rims(height_m: Array, grid: Grid, craters: Craters, sag_m: Array | float = 0.0) -> Rims:
    """Fit a plane to 16 points of each rim by least squares, and measure the depth below it.

    `sag_m` (N,) is subtracted from the depth: the bowl of a large old crater does not count as depth of a worn small
    crater on its floor.
    """
    angle = 2 * np.pi * np.arange(_N_RIM) / _N_RIM
    cos, sin = np.cos(angle), np.sin(angle)
    radius = craters.diameter_m[:, None] / 2
    x, y = craters.x_m[:, None], craters.y_m[:, None]
    rim = value_at(height_m, grid, x + radius * cos, y + radius * sin)
    # On a full circle the three unknowns of a plane decouple into Fourier sums.
    level = rim.mean(axis=1)
    slope_x = 2 * (rim * cos).mean(axis=1) / radius[:, 0]
    slope_y = 2 * (rim * sin).mean(axis=1) / radius[:, 0]
    normal = np.stack([-slope_x, -slope_y, np.ones_like(level)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    floor = value_at(height_m, grid, x + 0.2 * radius * cos[::2], y + 0.2 * radius * sin[::2]).mean(axis=1)
    centre = value_at(height_m, grid, craters.x_m, craters.y_m)
    return Rims(level, normal, np.maximum(level - (floor + centre) / 2 - sag_m, 0))


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
