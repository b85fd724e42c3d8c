"""What became of each crater on the finished height field: rim plane and depth."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perilune_render.terrain.craters import Craters
from perilune_render.terrain.grid import Grid
from perilune_shared.frames import Array

_N_RIM = 16


@dataclass(frozen=True, slots=True)
class Rims:
    """The rims of N craters as they are found on the ground."""

    z_m: Array
    """Mean height of the rim, O_L, metres (N,)."""
    normal: Array
    """Unit normal of the plane through the rim, O_L (N, 3)."""
    depth_m: Array
    """Mean height of the rim less that of the floor (the inner fifth), less the older ground's sag, at least 0 (N,)."""


def height_at(height_m: Array, grid: Grid, x_m: Array, y_m: Array) -> Array:
    """Ground height in metres at places (...), bilinear between vertices; the edge's height outside."""
    index = np.arange(len(grid.coordinates_m))
    row = np.interp(y_m, grid.coordinates_m, index)
    column = np.interp(x_m, grid.coordinates_m, index)
    return ndimage.map_coordinates(height_m, [row, column], order=1, mode="nearest")


def measure_rims(height_m: Array, grid: Grid, craters: Craters, sag_m: Array | float = 0.0) -> Rims:
    """Fit a plane to 16 points of each rim by least squares, and measure the depth below it.

    `sag_m` (N,) is taken off the depth: a worn crater on the floor of a large one is not as deep as that one's bowl.
    """
    angle = 2 * np.pi * np.arange(_N_RIM) / _N_RIM
    cos, sin = np.cos(angle), np.sin(angle)
    radius = craters.diameter_m[:, None] / 2
    x, y = craters.x_m[:, None], craters.y_m[:, None]
    rim = height_at(height_m, grid, x + radius * cos, y + radius * sin)
    # On a full circle the three unknowns of a plane decouple into Fourier sums.
    level = rim.mean(axis=1)
    slope_x = 2 * (rim * cos).mean(axis=1) / radius[:, 0]
    slope_y = 2 * (rim * sin).mean(axis=1) / radius[:, 0]
    normal = np.stack([-slope_x, -slope_y, np.ones_like(level)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    floor = height_at(height_m, grid, x + 0.2 * radius * cos[::2], y + 0.2 * radius * sin[::2]).mean(axis=1)
    centre = height_at(height_m, grid, craters.x_m, craters.y_m)
    return Rims(level, normal, np.maximum(level - (floor + centre) / 2 - sag_m, 0))
