r"""A scene: ground, craters and boulders of one site as plain data.

`grow_scene` builds it in layers, each drawn from its own stream of the scene's seed:

    6. boulders             o      .o             o .       set on the finished ground; rims are measured on it
    5. short waves     ~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~~     relief below 100 m, younger than the craters
    2. craters         __   ____   _________   ________     from oldest to youngest, with rays (4. without removed ones)
                         \_/    \_/         \_/
    1. base            --__--~~~~~--___--~~~~--__--~~~~     flat, or an elevation model; with long waves
                                                            (3. the model shows the craters of its catalogue)
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_render.terrain.albedo import RayLaw, add_patches, add_rays, brightness
from perilune_render.terrain.base import Base, base_of
from perilune_render.terrain.boulders import Boulders, check_boulders, draw_boulders
from perilune_render.terrain.craters.population import Craters, check_craters, draw_craters
from perilune_render.terrain.craters.removal import indices_of, near
from perilune_render.terrain.craters.rims import Rims, measure_rims
from perilune_render.terrain.craters.stamp import Stamped, stamp_craters
from perilune_render.terrain.elevation.catalogue import read_catalogue, remark
from perilune_render.terrain.elevation.model import (
    ElevationModel,
    read_elevation,
    refuse_beyond,
    refuse_unseen,
    remarks,
)
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.levels import checked_grid
from perilune_render.terrain.relief import check_waves
from perilune_shared.console.progress import say
from perilune_shared.geometry.curvature import drop_m
from perilune_shared.geometry.frames import Array

_ROUGHNESS_M = 100.0
"""Wavelength below which relief is added on top of the craters, metres."""
_MIN_RIM = 0.3
"""Smallest remaining share of the rim with which a crater counts as visible."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Ground, craters and boulders of one site, in O_L."""

    seed: int
    """Random seed of the scene."""
    latitude_deg: float
    """Latitude of the site, degrees."""
    longitude_deg: float
    """Longitude of the site, degrees."""
    grid: Grid
    """Positions of the vertices."""
    height_m: np.ndarray
    """Heights of the vertices above the plane of O_L (n_vertices,) float32, metres; the site is at 0."""
    albedo: np.ndarray
    """Factor on the reflectance (n_vertices,) float32, about 1."""
    craters: Craters
    """Visible craters without removed ones: first the craters of a catalogue, then generated craters, oldest first."""
    rims: Rims
    """Rims of `craters`, measured on the finished ground."""
    boulders: Boulders
    """Boulders on the ground; the index of a boulder is its boulder_id."""
    boulder_z_m: Array
    """Heights of the boulders' centres, metres."""
    dem_source: str
    """File name and hash of the elevation model, or 'procedural'."""
    real: np.ndarray
    """Whether each vertex (n_vertices,) is on known ground of the elevation model; false on procedural ground."""
    view: ViewEnvelope | None = None
    """The views for which the ground was made; None allows only one mesh (`perilune_render.terrain.levels`)."""
    removed: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    """crater_id (N,) of the craters that were removed from the ground, ascending."""

    @property
    def crater_id(self) -> np.ndarray:
        """Ids (N,) of `craters`: their indices in the same scene without removals."""
        everything = np.arange(len(self.craters) + len(self.removed))
        return np.delete(everything, self.removed)


@dataclass(frozen=True, slots=True)
class Soil:
    """The values at the vertices that craters change in place."""

    height_m: Array
    """Heights, metres (n_vertices,)."""
    albedo: Array
    """Factor on the reflectance (n_vertices,)."""

    def copy(self) -> "Soil":
        return Soil(self.height_m.copy(), self.albedo.copy())


@dataclass(frozen=True, slots=True)
class UncrateredGround:
    """The ground of a scene before its craters are stamped."""

    grid: Grid
    """Positions of the vertices."""
    base: Base
    """Base with long waves; its heights are the same array as the heights of `soil`."""
    soil: Soil
    """Heights and albedo without craters."""
    drawn: Craters
    """The craters to stamp, oldest first."""


def grow_scene(config: DatasetConfig, view: ViewEnvelope, seed: int) -> Scene:
    """Generate the scene of a seed: base, relief, craters from oldest to youngest, boulders.

    Craters that the configuration removes are omitted, with their rays and boulders. All random numbers are drawn as if
    these craters were present, and height 0 does not move. The heights change only within `craters.removal.REACH_RADII`
    crater radii of the removed craters. Craters with a share of their depth keep their rays and boulders; their ground
    is the mean, weighted by the share, of the ground with and without them. Raises UserError if frames of `view` need
    too many vertices, or if a crater to remove does not exist.
    """
    terrain = config.terrain
    ground = uncratered_ground(config, view, seed)
    grid, base, soil, drawn = ground.grid, ground.base, ground.soil, ground.drawn
    model = base.model
    wanted = config.removed_from(seed)
    uncratered = soil.copy() if wanted else soil
    stamped = _stamp(config, soil, grid, drawn, seed)
    visible = np.flatnonzero(stamped.rim_left >= _MIN_RIM)
    craters, sag = drawn.chosen(visible), stamped.sag_m[visible]
    # 3. Craters of the catalogue come first. The elevation model shows them, so nothing is stamped.
    n_real = 0
    if model is not None and terrain.catalogue is not None:
        real = read_catalogue(Path(terrain.catalogue), model, grid, terrain).craters
        craters, sag, n_real = real.joined(craters), np.concatenate([np.zeros(len(real)), sag]), len(real)
    # 4. Removed craters: stamp all others again, and use this ground only near the removed ones.
    removed = indices_of(wanted, n_real, len(craters), seed)
    raised_m, share = 0.0, config.depth_share
    if len(removed):
        again = _stamp(config, uncratered, grid, drawn, seed, visible[removed - n_real])
        gone = craters.chosen(removed)
        changed = near(*grid.vertices_xy(), gone)
        before_m = _at_site(soil.height_m, grid)
        soil.height_m[changed] = share * soil.height_m[changed] + (1 - share) * uncratered.height_m[changed]
        raised_m = float(_at_site(soil.height_m, grid) - before_m)
        new_sag_m = share * sag[n_real:] + (1 - share) * again.sag_m[visible]
        sag[n_real:] = np.where(near(craters.x_m, craters.y_m, gone)[n_real:], new_sag_m, sag[n_real:])
        if share:
            # The craters stay, only shallower.
            removed = removed[:0]
        else:
            soil.albedo[:] = uncratered.albedo
    # 5. Short waves on top of the craters; the site is at height 0; distant ground drops with the Moon's curvature.
    base.add_waves(grid, terrain.relief, seed, 0.0, _ROUGHNESS_M)
    height = soil.height_m
    height -= _at_site(height, grid) - raised_m
    if view.horizon:
        height -= drop_m(*grid.vertices_xy())
    # 6. Boulders and rims on the finished ground. Boulders are drawn around all craters, including removed ones.
    boulders = draw_boulders(terrain.boulders, grid, craters, seed, removed)
    remaining = np.delete(np.arange(len(craters)), removed)
    craters, sag = craters.chosen(remaining), sag[remaining]
    return Scene(
        seed,
        *_site_deg(config, model),
        grid,
        height.astype(np.float32),
        np.clip(soil.albedo, 0.5, 2.2).astype(np.float32),
        craters,
        measure_rims(height, grid, craters, sag),
        boulders,
        boulders.centre_height_m(value_at(height, grid, boulders.x_m, boulders.y_m)),
        "procedural" if model is None else model.source,
        base.beyond_m == 0,
        view,
        removed,
    )


def uncratered_ground(config: DatasetConfig, view: ViewEnvelope, seed: int) -> UncrateredGround:
    """The ground of a scene before its craters are stamped, and these craters.

    Raises UserError if frames of `view` need too many vertices.
    """
    terrain = config.terrain
    grid = checked_grid(terrain, view)
    model = model_of(terrain, grid.extent_m)
    # 1. Base and long waves.
    base = base_of(model, grid, terrain, seed)
    soil = Soil(base.height_m, np.ones(grid.n_vertices))
    base.add_waves(grid, terrain.relief, seed, _ROUGHNESS_M, np.inf)
    # 2. Craters; `grow_scene` drops the craters that younger craters have erased.
    drawn = base.permitted(draw_craters(terrain.craters, grid, seed, base.largest_m))
    if config.light.albedo_variation > 0:
        add_patches(soil.albedo, grid, config.light.albedo_variation, seed)
    return UncrateredGround(grid, base, soil, drawn)


def _stamp(
    config: DatasetConfig, soil: Soil, grid: Grid, craters: Craters, seed: int, removed: np.ndarray | None = None
) -> Stamped:
    """Add rays and stamp craters except the `removed` ones (indices), in place.

    Removed craters have 0 in `Stamped`.
    """
    remaining = np.arange(len(craters)) if removed is None else np.delete(np.arange(len(craters)), removed)
    variation, stays, law = config.light.albedo_variation, craters.chosen(remaining), config.terrain.craters
    if variation > 0:
        add_rays(soil.albedo, grid, craters, RayLaw(law.n_rayed, variation), seed, removed)
    brightening = variation * brightness(stays)
    stamped = stamp_craters(soil.height_m, soil.albedo, grid, stays, brightening, law.profile)
    if removed is None:
        return stamped
    sag, rim_left = np.zeros(len(craters)), np.zeros(len(craters))
    sag[remaining], rim_left[remaining] = stamped.sag_m, stamped.rim_left
    return Stamped(sag, rim_left)


def _at_site(height_m: Array, grid: Grid) -> Array:
    """The height of the ground at the site, metres ()."""
    return value_at(height_m, grid, 0.0, 0.0)


def check_ground(config: DatasetConfig, view: ViewEnvelope) -> Grid:
    """Check the settings and input files of the ground before it is generated; return its grid.

    Raises UserError if the ground cannot be generated. Prints remarks on the elevation model and its catalogue.
    """
    grid = checked_grid(config.terrain, view)
    check_waves(config.terrain.relief, grid)
    check_craters(config.terrain.craters, grid)
    check_boulders(config.terrain.boulders, grid)
    model = model_of(config.terrain, grid.extent_m)
    if model is not None:
        refuse_unseen(model, grid, config.terrain.elevation)
        refuse_beyond(model, grid, config.terrain.elevation.outside)
        for line in remarks(model, grid, config.terrain.elevation.outside):
            say(line, style="yellow")
        if config.terrain.catalogue is not None:
            path = Path(config.terrain.catalogue)
            say(remark(path, read_catalogue(path, model, grid, config.terrain)), style="yellow")
    return grid


def site_of(config: DatasetConfig) -> tuple[float, float]:
    """Latitude and longitude of the site, degrees.

    Raises UserError if the elevation model cannot be read.
    """
    return _site_deg(config, model_of(config.terrain))


def model_of(terrain: TerrainConfig, ground_m: float | None = None) -> ElevationModel | None:
    """The elevation model of a configuration, or None without one.

    `ground_m` is the side of the ground, metres (see `read_elevation`). Raises UserError if the model cannot be read.
    """
    return None if terrain.dem is None else read_elevation(Path(terrain.dem), terrain.elevation, ground_m)


def _site_deg(config: DatasetConfig, model: ElevationModel | None) -> tuple[float, float]:
    """Latitude and longitude of the site, degrees."""
    if model is None:
        return config.terrain.latitude_deg, config.terrain.longitude_deg
    return model.latitude_deg, model.longitude_deg
