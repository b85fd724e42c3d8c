"""Levels: several meshes of the ground below one trajectory, used if one mesh would be too large.

One mesh for a whole descent would combine the finest detail of the last frames with the wide ground of the first
frames. A level is a mesh for the frames of one band of camera heights. Its spacing follows the smallest ground pixel of
the band, and it is centred on the ground that the trajectory shows within the band. All levels are sampled from the
ground of the scene (`perilune_render.terrain.level_ground`), so craters, rims and labels do not depend on levels.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perilune_render.config.terrain import LARGEST_SPACING_PX, TerrainConfig
from perilune_render.terrain.envelope import SeenGround, ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid, grid_of
from perilune_shared.errors import UserError

_WIDEST_BAND = 1.25
"""Largest ratio of the highest to the lowest height in the band of a level. With wider bands, the spacing and the
smallest craters would change visibly from one level to the next."""
_GROUND_PER_MESH = 10
"""Largest number of vertices of a scene's ground, divided by `terrain.max_vertices`, which limits each mesh. During
generation, a vertex needs about a sixth of the memory that it needs in Blender."""


@dataclass(frozen=True, slots=True)
class Level:
    """A mesh of one trajectory."""

    highest_m: float
    """Height of the camera above O_L's plane below which frames use this level, metres; inf for the coarsest."""
    grid: Grid
    """Positions of the vertices."""


def cut_levels(terrain: TerrainConfig, view: ViewEnvelope, approach_deg: int) -> tuple[Level, ...]:
    """The levels of a trajectory, finest first.

    There is one level if the whole ground has at most `terrain.max_vertices`. The trajectory comes from the direction
    `approach_deg` (clockwise from north) to within half a degree. From the lowest upwards, each band of heights is as
    wide as `terrain.max_vertices` and _WIDEST_BAND allow. Spacing is at most `terrain.spacing_px` times the smallest
    ground pixel of the band. Raises UserError if no level fits.
    """
    whole = checked_grid(terrain, view)
    if view.seen is None or whole.n_vertices <= terrain.max_vertices:
        return (Level(np.inf, whole),)
    levels, first, last = [], 0, len(view.seen.z_m) - 1
    while first < last:
        band = _band(terrain, view, view.seen, approach_deg, first)
        widest = int(np.searchsorted(view.seen.z_m, _WIDEST_BAND * view.seen.z_m[first], side="right")) - 1
        end = _last_that_fits(band, first + 1, min(max(widest, first + 1), last), terrain.max_vertices)
        levels.append(Level(float(view.seen.z_m[end]) if end < last else np.inf, band(end)))
        first = end
    return tuple(levels)


def checked_grid(terrain: TerrainConfig, view: ViewEnvelope) -> Grid:
    """The grid of the ground for all views (`graded_grid`).

    Raises UserError if a mesh needs more vertices than `terrain.max_vertices`, or if the ground needs more than
    _GROUND_PER_MESH times this number.
    """
    grid = graded_grid(terrain, view)
    if grid.n_vertices > terrain.max_vertices:
        needed = _needed(terrain, view)
        if needed > terrain.max_vertices:
            raise _refusal(terrain, view, needed)
    return grid


def level_index(levels: tuple[Level, ...], z_m: float) -> int:
    """Index of the level for a frame whose camera is `z_m` above O_L's plane, metres."""
    return int(np.searchsorted([level.highest_m for level in levels[:-1]], z_m, side="right"))


def _band(
    terrain: TerrainConfig, view: ViewEnvelope, seen: SeenGround, approach_deg: int, first: int
) -> Callable[[int], Grid]:
    """Function from a last index to the grid of a band: from index `first` of `seen` to the last index."""
    all_low, all_high = seen.box_m(approach_deg)
    edge_m = float(view.reach_m[-1])

    def grid(last: int) -> Grid:
        low, high = all_low[first : last + 1], all_high[first : last + 1]
        centre = (low.min(axis=0) + high.max(axis=0)) / 2
        reach = np.maximum.accumulate(np.maximum(high - centre, centre - low).max(axis=1))
        spacing = terrain.spacing_px * seen.height_m[first : last + 1] / view.focal_px
        return grid_of(reach, spacing, (float(centre[0]), float(centre[1])), edge_m + float(np.abs(centre).max()))

    return grid


def _needed(terrain: TerrainConfig, view: ViewEnvelope) -> int:
    """Smallest limit of vertices per mesh with which the ground can be rendered.

    The limit must allow the mesh of every band between two neighbouring heights of `view.seen`, and the number of
    vertices of the whole ground divided by _GROUND_PER_MESH. A limit that allows the whole ground as one mesh also
    suffices.
    """
    whole = graded_grid(terrain, view).n_vertices
    if view.seen is None:
        return whole
    bands = range(len(view.seen.z_m) - 1)
    narrowest = max(_band(terrain, view, view.seen, 0, k)(k + 1).n_vertices for k in bands)
    return min(whole, max(narrowest, -(-whole // _GROUND_PER_MESH)))


def _refusal(terrain: TerrainConfig, view: ViewEnvelope, needed: int) -> UserError:
    """The error if no level fits; it states the smallest spacing that fits, rounded up to 0.01."""
    spacing_px, most = terrain.spacing_px, terrain.max_vertices

    def allowed(hundredths: int) -> bool:
        return _needed(terrain.model_copy(update={"spacing_px": hundredths / 100}), view) <= most

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
    """The last index from `low` to `high` whose band has at most `most` vertices.

    The band of `low` is not checked.
    """
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if band(middle).n_vertices <= most else (low, middle - 1)
    return low
