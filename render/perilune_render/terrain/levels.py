"""Levels: the ground sampled once for each band of the camera's height, where one mesh would have too many vertices.

One mesh for a whole descent has the finest detail of the last frames within the wide ground of the first ones. A level
is a mesh for the frames of one band: its spacing follows the smallest ground pixel of that band, and it is centred on
the ground that the band shows. All levels sample the same ground (`perilune_render.terrain.scene`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from perilune_render.config_terrain import LARGEST_SPACING_PX, TerrainConfig
from perilune_render.terrain.envelope import SeenGround, ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid, grid_of
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

_WIDEST_BAND = 1.25
"""Largest ratio of the heights of a level's band. In a wider one the spacing, and with it the smallest craters, would
change visibly between two frames."""


@dataclass(frozen=True, slots=True)
class LevelPlan:
    """A level before its ground is generated."""

    highest_m: float
    """Height of the camera above O_L's plane below which frames use this level, metres; inf for the coarsest."""
    grid: Grid
    """Positions of the vertices."""


def cut_levels(terrain: TerrainConfig, view: ViewEnvelope) -> tuple[LevelPlan, ...]:
    """The levels for the views of a camera, finest first: one if its mesh has at most `terrain.max_vertices`.

    Otherwise each band of heights, from the lowest, is as wide as this limit on each level and _WIDEST_BAND allow.
    Spacing is at most `terrain.spacing_px` times the smallest ground pixel of the band. Raises UserError if no level
    fits.
    """
    grid = graded_grid(terrain, view)
    if grid.n_vertices <= terrain.max_vertices:
        return (LevelPlan(np.inf, grid),)
    edge = grid.extent_m / 2
    if view.seen is None or not _fits(terrain, view, edge):
        raise _refusal(terrain, view, edge)
    levels, first, last = [], 0, len(view.seen.z_m) - 1
    while first < last:
        band = _band(terrain, view, view.seen, edge, first)
        widest = int(np.searchsorted(view.seen.z_m, _WIDEST_BAND * view.seen.z_m[first], side="right")) - 1
        end = _last_that_fits(band, first + 1, min(max(widest, first + 1), last), terrain.max_vertices)
        levels.append(LevelPlan(float(view.seen.z_m[end]) if end < last else np.inf, band(end)))
        first = end
    return tuple(levels)


def finest_level(grids: Sequence[Grid], x_m: Array, y_m: Array) -> tuple[np.ndarray, Array]:
    """Index of the grid with the smallest spacing at each place (N,), the first if several, and that spacing (N,)."""
    index, spacing = np.zeros(len(x_m), np.int64), grids[0].spacing_under(x_m, y_m)
    for k, grid in enumerate(grids[1:], start=1):
        own = grid.spacing_under(x_m, y_m)
        finer = own < spacing
        index[finer], spacing[finer] = k, own[finer]
    return index, spacing


def _band(
    terrain: TerrainConfig, view: ViewEnvelope, seen: SeenGround, edge_m: float, first: int
) -> Callable[[int], Grid]:
    """The grid of a band of `seen` from the index `first` to a given one, both included."""

    def grid(last: int) -> Grid:
        low, high = seen.low_m[first : last + 1], seen.high_m[first : last + 1]
        centre = (low.min(axis=0) + high.max(axis=0)) / 2
        reach = np.maximum.accumulate(np.maximum(high - centre, centre - low).max(axis=1))
        spacing = terrain.spacing_px * seen.height_m[first : last + 1] / view.focal_px
        return grid_of(reach, spacing, (float(centre[0]), float(centre[1])), edge_m + float(np.abs(centre).max()))

    return grid


def _fits(terrain: TerrainConfig, view: ViewEnvelope, edge_m: float) -> bool:
    """Whether every band between neighbouring heights has few enough vertices."""
    return _thinnest(terrain, view, edge_m) <= terrain.max_vertices


def _thinnest(terrain: TerrainConfig, view: ViewEnvelope, edge_m: float) -> int:
    """Number of vertices that the limit must allow: that of the largest of the narrowest bands, or of the one mesh."""
    whole = graded_grid(terrain, view).n_vertices
    if view.seen is None:
        return whole
    bands = range(len(view.seen.z_m) - 1)
    return min(whole, max(_band(terrain, view, view.seen, edge_m, k)(k + 1).n_vertices for k in bands))


def _refusal(terrain: TerrainConfig, view: ViewEnvelope, edge_m: float) -> UserError:
    """The error if no level fits; it names the smallest spacing that does, rounded up to 0.01."""
    spacing_px, most = terrain.spacing_px, terrain.max_vertices
    needed = _thinnest(terrain, view, edge_m)

    def allowed(hundredths: int) -> bool:
        return _fits(terrain.model_copy(update={"spacing_px": hundredths / 100}), view, edge_m)

    low, high = 1, int(100 * LARGEST_SPACING_PX)
    advice = (
        "a larger dataset.terrain.max_vertices, fewer or wider pixels of dataset.camera, or a higher end_altitude_m"
    )
    if allowed(high):
        while low < high:
            middle = (low + high) // 2
            low, high = (low, middle) if allowed(middle) else (middle + 1, high)
        advice = f"at least {high / 100:g}, or a larger dataset.terrain.max_vertices"
    return UserError(
        "configuration",
        "dataset.terrain.spacing_px",
        f"{spacing_px} needs {needed:,} vertices",
        f"{advice} (dataset.terrain.max_vertices is {most:,})",
    )


def _last_that_fits(band: Callable[[int], Grid], low: int, high: int, most: int) -> int:
    """The last index from `low` to `high` up to which a band has at most `most` vertices; `low` is taken to fit."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if band(middle).n_vertices <= most else (low, middle - 1)
    return low
