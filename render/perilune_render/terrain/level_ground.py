"""The ground of a level: a scene's ground, averaged over the cell around each vertex of the level.

A level is one of several meshes of the same ground (`perilune_render.terrain.levels`).
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from perilune_render.config.terrain import BouldersConfig
from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import corners
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array

_MAX_SAMPLES = 8
"""Largest number of sample points along one side of a cell; only cells out of view would need more."""


class _Mesh(NamedTuple):
    """The grid on whose vertices the field is given."""

    centre_x: float
    """x of the grid's centre, O_L, metres."""
    centre_y: float
    """y of the grid's centre, O_L, metres."""
    n_half: int
    """`Grid.n_half`."""
    half_widths: Array
    """`Grid.half_widths_m`."""
    spacings: Array
    """`Grid.spacings_m`."""


class _Cells(NamedTuple):
    """The cells of the N vertices of a level."""

    centre_x: float
    """x of the level's centre, O_L, metres."""
    centre_y: float
    """y of the level's centre, O_L, metres."""
    n_inner: int
    """Number of vertices in the level's inner square, which come first."""
    n_ring: int
    """Number of vertices in each ring of the level."""
    around: Array
    """Sides of the cells along the ring, metres, for the inner square and each ring (R + 1,)."""
    across: Array
    """Sides of the cells across the ring, metres (R + 1,)."""
    x: Array
    """x of the vertices, O_L, metres (N,)."""
    y: Array
    """y of the vertices, O_L, metres (N,)."""


def on_level(scene: Scene, grid: Grid, boulders: BouldersConfig) -> Scene:
    """The scene with the ground of a level, and only the boulders that are large enough for its mesh."""
    height, albedo = (averaged(field, scene.grid, grid) for field in (scene.height_m, scene.albedo))
    real = averaged(scene.real, scene.grid, grid) > 0.5 if scene.real.any() else np.zeros(grid.n_vertices, bool)
    is_large = scene.boulders.diameter_m >= boulders.min_diameter_spacings * grid.spacing_under(
        scene.boulders.x_m, scene.boulders.y_m
    )
    return dataclasses.replace(
        scene,
        grid=grid,
        height_m=height,
        albedo=albedo,
        real=real,
        boulders=scene.boulders.chosen(is_large),
        boulder_z_m=scene.boulder_z_m[is_large],
    )


def averaged(field: np.ndarray, whole: Grid, grid: Grid) -> np.ndarray:
    """Means (n_vertices,) float32 of a field over the cell around each vertex of `grid`.

    The field is given on the vertices of `whole` and interpolated at evenly spaced points of a cell. Along each side of
    a cell there are about as many points as `whole` has vertices, from 1 to _MAX_SAMPLES. Outside `whole` the field has
    the values of its border.
    """
    n_inner, n_ring = (2 * grid.n_half + 1) ** 2, 8 * grid.n_half
    mesh = _Mesh(whole.centre_x_m, whole.centre_y_m, whole.n_half, whole.half_widths_m, whole.spacings_m)
    cells = _Cells(grid.centre_x_m, grid.centre_y_m, n_inner, n_ring, *grid.cell_sides_m, *grid.vertices_xy())
    return _averaged(field, mesh, cells)


@njit()
def _averaged(field, mesh, cells):
    x0, y0, n, half_widths, spacings = mesh
    cx, cy, n_inner, n_ring, around, across, x, y = cells
    means = np.empty(len(x), np.float32)
    for k in range(len(x)):
        ring = 0 if k < n_inner else 1 + (k - n_inner) // n_ring
        px, py = x[k] - x0, y[k] - y0
        # A ring runs along y where it crosses the x axis.
        if abs(x[k] - cx) > abs(y[k] - cy):
            side_x, side_y = across[ring], around[ring]
        else:
            side_x, side_y = around[ring], across[ring]
        nearest = np.searchsorted(half_widths, max(abs(px), abs(py)))
        spacing = spacings[min(nearest, len(spacings) - 1)]
        n_x = min(max(round(side_x / spacing), 1), _MAX_SAMPLES)
        n_y = min(max(round(side_y / spacing), 1), _MAX_SAMPLES)
        total = 0.0
        for j in range(n_y):
            for i in range(n_x):
                u = px + ((i + 0.5) / n_x - 0.5) * side_x
                v = py + ((j + 0.5) / n_y - 0.5) * side_y
                a, b, c, d, f, g = corners(u, v, n, half_widths)
                total += (field[a] * (1 - f) + field[b] * f) * (1 - g) + (field[c] * (1 - f) + field[d] * f) * g
        means[k] = total / (n_x * n_y)
    return means
