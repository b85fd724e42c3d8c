"""Shaded relief around the landing site, from the ground of a scene and its elevation model."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perilune_render.dataset.real_ground import outline_m
from perilune_render.engines.heightfield.query import first_hits
from perilune_render.engines.heightfield.surface import surface_of
from perilune_render.terrain.elevation.model import ElevationModel, raster_places
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.level_ground import averaged
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array

_N_HALF = 450
"""Vertex spacings from the middle of the map to its edge."""
LARGEST_WIDTH = 8.0
"""Largest width of the map, as a multiple of the ground's width. Of a larger elevation model, only the part around the
site is shown."""
_MARGIN = 1.03
"""Width of the map as a multiple of the width of ground and model, if there is a model."""
_LIFT = 0.02
"""Height above the ground at which rays to the Sun begin, in vertex spacings."""


@dataclass(frozen=True, slots=True)
class SiteMap:
    """A square map in O_L's plane.

    Row 0 is the northern edge (smallest y), column 0 is the western edge (largest x).
    """

    height_m: Array
    """Heights above the site (n, n), metres; NaN where no height is known."""
    shade: Array
    """Cosine of the angle between the ground's normal and the Sun (n, n), at least 0."""
    sunlit: np.ndarray
    """Whether the centre of the Sun is visible from each point (n, n)."""
    centre_m: tuple[float, float]
    """x and y of the map's middle, metres."""
    half_width_m: float
    """Distance from the middle to the edges, metres."""
    ground_half_m: float
    """Half the side of the scene's ground around the site, metres."""
    outline_m: Array | None
    """Points (N, 2) on the edge of the elevation model, metres; None without an edge to draw."""


def site_map(scene: Scene, model: ElevationModel | None, sun: Array) -> SiteMap:
    """The map of a scene's ground, and of the elevation model around it, lit from `sun` (3,), O_L.

    The ground of the scene covers everything that frames show. Beyond this ground, the map has the heights of the
    model, which cast no shadows in frames.
    """
    ground_half = scene.grid.extent_m / 2
    outline = outline_m(model) if model is not None else None
    if outline is not None and not len(outline):
        outline = None
    grid = _grid(ground_half, outline)
    x, y = grid.vertices_xy()
    height, known = averaged(scene.height_m, scene.grid, grid).astype(np.float64), np.ones(grid.n_vertices, bool)
    if model is not None:
        inside = np.maximum(np.abs(x), np.abs(y)) <= ground_half
        column, row = raster_places(model, x, y)
        rows, columns = model.height_m.shape
        on = (column >= 0) & (column <= columns) & (row >= 0) & (row <= rows)
        around = ndimage.map_coordinates(model.height_m, [row - 0.5, column - 0.5], order=1, mode="nearest")
        both = inside & on
        around += np.median(height[both] - around[both]) if both.any() else 0.0
        known = inside | on
        height = np.where(inside, height, around)
        height[~known] = height[known].min()
    seen = np.isinf(first_hits(surface_of(_bare(scene, grid, height)), *_rays(grid, height, sun), boulders=False)[0])
    n = 2 * grid.n_half + 1
    step = float(grid.spacings_m[0])
    slope_y, slope_x = np.gradient(height.reshape(n, n), step)
    shade = (sun[2] - slope_x * sun[0] - slope_y * sun[1]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    turned = [values.reshape(n, n)[:, ::-1] for values in (np.where(known, height, np.nan), shade, seen)]
    centre = grid.centre_x_m, grid.centre_y_m
    return SiteMap(
        turned[0], np.maximum(turned[1], 0), turned[2] & (turned[1] > 0), centre, n / 2 * step, ground_half, outline
    )


def _grid(ground_half_m: float, outline: Array | None) -> Grid:
    """The vertices of the map, which covers the ground of the scene and the model up to LARGEST_WIDTH."""
    corners = np.array([[-ground_half_m, -ground_half_m], [ground_half_m, ground_half_m]])
    if outline is not None:
        corners = np.stack([np.minimum(corners[0], outline.min(axis=0)), np.maximum(corners[1], outline.max(axis=0))])
    centre, half = corners.mean(axis=0), float(np.ptp(corners, axis=0).max()) / 2
    if half > LARGEST_WIDTH * ground_half_m:
        centre, half = np.zeros(2), LARGEST_WIDTH * ground_half_m
    if outline is not None:
        half *= _MARGIN
    return Grid(_N_HALF, np.array([half]), float(centre[0]), float(centre[1]))


def _bare(scene: Scene, grid: Grid, height_m: Array) -> Scene:
    """The scene with the heights `height_m` on `grid` as its ground, without boulders."""
    return dataclasses.replace(
        scene,
        grid=grid,
        height_m=height_m.astype(np.float32),
        albedo=np.ones(grid.n_vertices, np.float32),
        real=np.zeros(grid.n_vertices, bool),
        boulders=scene.boulders.chosen(np.zeros(len(scene.boulders), bool)),
        boulder_z_m=np.empty(0),
    )


def _rays(grid: Grid, height_m: Array, sun: Array) -> tuple[Array, Array]:
    """Origins and directions (n_vertices, 3) of rays from the ground to the Sun."""
    x, y = grid.vertices_xy()
    origins = np.stack([x, y, height_m + _LIFT * grid.spacings_m[0]], axis=1)
    return origins, np.tile(np.asarray(sun, np.float64), (len(x), 1))
