"""A scene: ground, craters and boulders of one site as plain data."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.config_terrain import BouldersConfig
from perilune_render.terrain.albedo import add_patches, add_rays, brightness
from perilune_render.terrain.base import Base, base_of
from perilune_render.terrain.boulders import Boulders, draw_boulders
from perilune_render.terrain.craters.population import Craters, draw_craters
from perilune_render.terrain.craters.rims import Rims, measure_rims
from perilune_render.terrain.craters.stamp import Stamped, stamp_craters
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.model import ElevationModel, read_elevation, refuse_beyond, remarks, resolved_m
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.levels import cut_levels, finest_level
from perilune_render.terrain.relief import check_waves
from perilune_shared.geometry.frames import Array
from perilune_shared.progress import say

_ROUGHNESS_M = 100.0
"""Wavelength below which relief is added on top of the craters, metres."""
_LEAST_RIM = 0.3
"""Share of a crater's rim that younger craters must leave; with less, the crater is no longer counted."""

_LEAST_ON_LEVEL = 1.5
"""Smallest diameter of a crater on a level, vertex spacings. It is smaller than the least `min_diameter_spacings`, so
that craters appear on a change of level before they are a pixel wide."""


@dataclass(frozen=True, slots=True)
class Level:
    """The ground of a scene as sampled for the frames of one band of heights."""

    highest_m: float
    """Height of the camera above O_L's plane below which frames show this level, metres."""
    grid: Grid
    """Positions of the vertices."""
    height_m: np.ndarray
    """Heights of the vertices (n_vertices,) float32, metres."""
    albedo: np.ndarray
    """Factor on the reflectance (n_vertices,) float32."""
    real: np.ndarray
    """Whether each vertex (n_vertices,) is on known ground of the elevation model."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Ground, craters and boulders of one site, in O_L.

    With several levels (`perilune_render.terrain.levels`) grid, height_m, albedo and real are those of the coarsest,
    which covers all of the ground.
    """

    seed: int
    """Random seed of the scene."""
    latitude_deg: float
    """Latitude of the site, degrees."""
    longitude_deg: float
    """Longitude of the site, degrees."""
    grid: Grid
    """Positions of the vertices."""
    height_m: np.ndarray
    """Heights of the vertices (n_vertices,) float32, metres; the site is at 0."""
    albedo: np.ndarray
    """Factor on the reflectance (n_vertices,) float32, about 1."""
    craters: Craters
    """Craters of a catalogue, then generated ones that are still visible, oldest first; crater_id is the index."""
    rims: Rims
    """Rims of the same craters, measured on the finished ground."""
    boulders: Boulders
    """Boulders; boulder_id is the index."""
    boulder_z_m: Array
    """Heights of the boulders' centres, metres."""
    dem_source: str
    """Name and hash of the elevation model, or 'procedural'."""
    real: np.ndarray
    """Whether each vertex (n_vertices,) is on known ground of the elevation model; false on procedural ground."""
    finer: tuple[Level, ...] = ()
    """The other levels, finest first; empty if one mesh serves all frames."""

    def level_index(self, z_m: float) -> int:
        """Index, finest first, of the level that a frame with the camera at z_m shows; 0 if there is only one."""
        return int(np.searchsorted([level.highest_m for level in self.finer], z_m, side="right"))

    def at_level(self, index: int, boulders: BouldersConfig) -> "Scene":
        """The scene with the ground of one level alone, and the boulders that are large enough for its mesh."""
        if not self.finer:
            return self
        own = self if index == len(self.finer) else self.finer[index]
        local = own.grid.spacing_under(self.boulders.x_m, self.boulders.y_m)
        shown = self.boulders.diameter_m >= boulders.min_diameter_spacings * local
        return dataclasses.replace(
            self,
            grid=own.grid,
            height_m=own.height_m,
            albedo=own.albedo,
            real=own.real,
            boulders=self.boulders.chosen(shown),
            boulder_z_m=self.boulder_z_m[shown],
            finer=(),
        )


def grow_scene(config: DatasetConfig, view: ViewEnvelope, seed: int) -> Scene:
    """Generate the scene of a seed: base, relief, craters from oldest to youngest, boulders.

    Craters and boulders are drawn once. Each level samples the same ground, with the craters and boulders that are
    large enough for its spacing. Rims and heights of boulders are measured on the level with the smallest spacing
    there.
    """
    terrain, boulder_sizes = config.terrain, config.terrain.boulders.min_diameter_spacings
    plans = cut_levels(terrain, view)
    grids = [plan.grid for plan in plans]
    whole = graded_grid(terrain, view) if len(plans) > 1 else grids[0]
    model = read_elevation(Path(terrain.dem)) if terrain.dem is not None else None
    finest = base_of(model, grids[0], terrain, seed, grids)
    drawn = finest.permitted(draw_craters(terrain.craters, whole, seed, finest.largest_m))
    home, spacing = finest_level(grids, drawn.x_m, drawn.y_m)
    if len(plans) > 1:
        # Beside the ground in view no level is fine enough for the smallest craters.
        resolved = drawn.diameter_m >= terrain.craters.min_diameter_spacings * spacing
        drawn, home = drawn.chosen(resolved), home[resolved]
    sag, rim_left = np.zeros(len(drawn)), np.ones(len(drawn))
    heights, albedos, real = [], [], []
    for k, grid in enumerate(grids):
        base = base_of(model, grid, terrain, seed, grids, finest) if k else finest
        albedo, shown, stamped = _grow_level(config, base, grid, whole, drawn, seed)
        own = home[shown] == k
        sag[shown[own]], rim_left[shown[own]] = stamped.sag_m[own], stamped.rim_left[own]
        heights.append(base.height_m)
        albedos.append(np.clip(albedo, 0.5, 2.2).astype(np.float32))
        real.append(base.beyond_m == 0)
    visible = rim_left >= _LEAST_RIM
    craters, sag = drawn.chosen(visible), sag[visible]
    if model is not None and terrain.catalogue is not None:
        listed = read_catalogue(Path(terrain.catalogue), model, whole, terrain.craters, resolved_m(model))
        craters, sag = listed.joined(craters), np.concatenate([np.zeros(len(listed)), sag])
    datum = value_at(heights[0], grids[0], 0.0, 0.0)
    for height in heights:
        height -= datum
    boulders = draw_boulders(terrain.boulders, whole, craters, seed)
    if len(plans) > 1:
        _, spacing = finest_level(grids, boulders.x_m, boulders.y_m)
        boulders = boulders.chosen(boulders.diameter_m >= boulder_sizes * spacing)
    levels = [
        Level(plan.highest_m, plan.grid, height.astype(np.float32), *fields)
        for plan, height, *fields in zip(plans, heights, albedos, real, strict=True)
    ]
    return Scene(
        seed,
        *_place(config, model),
        grids[-1],
        levels[-1].height_m,
        levels[-1].albedo,
        craters,
        _rims_of(heights, grids, craters, sag),
        boulders,
        boulders.centre_height_m(_heights_at(heights, grids, boulders.x_m, boulders.y_m)),
        "procedural" if model is None else model.source,
        levels[-1].real,
        tuple(levels[:-1]),
    )


def _grow_level(
    config: DatasetConfig, base: Base, grid: Grid, whole: Grid, craters: Craters, seed: int
) -> tuple[Array, np.ndarray, Stamped]:
    """Add relief and craters to a level's base, in place.

    Returns the albedo (n_vertices,), the indices (M,) of the craters that are large enough for the level, and the
    results of stamping them.
    """
    terrain, variation = config.terrain, config.light.albedo_variation
    base.add_waves(grid, terrain.relief, seed, _ROUGHNESS_M, np.inf, whole)
    albedo = np.ones(grid.n_vertices)
    if variation > 0:
        add_patches(albedo, grid, variation, seed, whole)
        add_rays(albedo, grid, craters, terrain.craters.n_rayed, variation, seed, whole)
    shown = np.arange(len(craters))
    if grid is not whole:
        shown = np.flatnonzero(craters.diameter_m >= _LEAST_ON_LEVEL * grid.spacing_under(craters.x_m, craters.y_m))
    own = craters.chosen(shown)
    stamped = stamp_craters(
        base.height_m,
        albedo,
        grid,
        own,
        variation * brightness(own),
        terrain.craters.profile,
        by_area=grid is not whole,
    )
    base.add_waves(grid, terrain.relief, seed, 0.0, _ROUGHNESS_M, whole)
    return albedo, shown, stamped


def _rims_of(heights: Sequence[Array], grids: Sequence[Grid], craters: Craters, sag_m: Array) -> Rims:
    """Rims of N craters, each measured on the level with the smallest spacing there."""
    n = len(craters)
    home, _ = finest_level(grids, craters.x_m, craters.y_m)
    rims = Rims(np.empty(n), np.empty((n, 3)), np.empty(n))
    for k, (height, grid) in enumerate(zip(heights, grids, strict=True)):
        rows = np.flatnonzero(home == k)
        own = measure_rims(height, grid, craters.chosen(rows), sag_m[rows])
        rims.z_m[rows], rims.normal[rows], rims.depth_m[rows] = own.z_m, own.normal, own.depth_m
    return rims


def _heights_at(heights: Sequence[Array], grids: Sequence[Grid], x_m: Array, y_m: Array) -> Array:
    """Heights of the ground at places (N,), metres, each on the level with the smallest spacing there."""
    home, _ = finest_level(grids, x_m, y_m)
    found = np.empty(len(x_m))
    for k, (height, grid) in enumerate(zip(heights, grids, strict=True)):
        rows = np.flatnonzero(home == k)
        found[rows] = value_at(height, grid, x_m[rows], y_m[rows])
    return found


def check_ground(config: DatasetConfig, view: ViewEnvelope) -> None:
    """Check grid, relief and input files before the ground is generated. Raises UserError.

    Prints remarks on the elevation model.
    """
    cut_levels(config.terrain, view)
    grid = graded_grid(config.terrain, view)
    check_waves(config.terrain.relief, grid)
    if config.terrain.dem is not None:
        model = read_elevation(Path(config.terrain.dem))
        refuse_beyond(model, grid, config.terrain.elevation.outside)
        for line in remarks(model, grid, config.terrain.elevation.outside):
            say(line, style="yellow")
        if config.terrain.catalogue is not None:
            read_catalogue(Path(config.terrain.catalogue), model, grid, config.terrain.craters, resolved_m(model))


def _place(config: DatasetConfig, model: ElevationModel | None) -> tuple[float, float]:
    if model is None:
        return config.terrain.latitude_deg, config.terrain.longitude_deg
    return model.latitude_deg, model.longitude_deg
