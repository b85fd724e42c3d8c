"""Measure each crater on the finished ground: rim plane and depth."""

from dataclasses import dataclass

import numpy as np

from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
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
    """Depths, metres (N,), at least 0: mean height of the rim, minus height of the floor, minus the `sag_m` of
    `measure_rims`. For the height of the floor, heights at a fifth of the radius are averaged; the floor is halfway
    between this average and the height at the centre."""


def measure_rims(height_m: Array, grid: Grid, craters: Craters, sag_m: Array | float = 0.0) -> Rims:
    """Fit a plane to 16 points of each rim by least squares, and measure the depth below the rim.

    `sag_m` (N,), metres, is the height difference from rim to centre of the older ground under each crater
    (`stamp.Stamped`). It is subtracted from the depth, because the bowl of a large old crater must not count as depth
    of a small worn crater on its floor.
    """
    angle = 2 * np.pi * np.arange(_N_RIM) / _N_RIM
    cos, sin = np.cos(angle), np.sin(angle)
    radius = craters.diameter_m[:, None] / 2
    x, y = craters.x_m[:, None], craters.y_m[:, None]
    rim = value_at(height_m, grid, x + radius * cos, y + radius * sin)
    # For points evenly spaced on a circle, the plane's three unknowns decouple into Fourier sums.
    level = rim.mean(axis=1)
    slope_x = 2 * (rim * cos).mean(axis=1) / radius[:, 0]
    slope_y = 2 * (rim * sin).mean(axis=1) / radius[:, 0]
    normal = np.stack([-slope_x, -slope_y, np.ones_like(level)], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    floor = value_at(height_m, grid, x + 0.2 * radius * cos[::2], y + 0.2 * radius * sin[::2]).mean(axis=1)
    centre = value_at(height_m, grid, craters.x_m, craters.y_m)
    return Rims(level, normal, np.maximum(level - (floor + centre) / 2 - sag_m, 0))
