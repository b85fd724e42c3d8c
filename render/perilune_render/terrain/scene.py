"""A scene: ground, craters and boulders of one site as plain data."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_render.config import DatasetConfig
from perilune_render.terrain.albedo import add_patches, add_rays, brightness
from perilune_render.terrain.base import base_of
from perilune_render.terrain.boulders import Boulders, draw_boulders
from perilune_render.terrain.craters.population import Craters, draw_craters
from perilune_render.terrain.craters.rims import Rims, measure_rims
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.elevation.catalogue import read_catalogue
from perilune_render.terrain.elevation.model import ElevationModel, read_elevation, refuse_beyond, remarks, resolved_m
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.levels import check_levels
from perilune_render.terrain.relief import check_waves
from perilune_shared.geometry.frames import Array
from perilune_shared.progress import say

_ROUGHNESS_M = 100.0
"""Wavelength below which relief is added on top of the craters, metres."""
_LEAST_RIM = 0.3
"""Share of a crater's rim that younger craters must leave; with less, the crater is no longer counted."""


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
    view: ViewEnvelope | None = None
    """The views that the ground was made for; None allows one mesh only (`perilune_render.terrain.levels`)."""


def grow_scene(config: DatasetConfig, view: ViewEnvelope, seed: int) -> Scene:
    """Generate the scene of a seed: base, relief, craters from oldest to youngest, boulders.

    Raises UserError if frames of `view` need too many vertices.
    """
    check_levels(config.terrain, view)
    terrain = config.terrain
    grid = graded_grid(terrain, view)
    model = read_elevation(Path(terrain.dem)) if terrain.dem is not None else None
    base = base_of(model, grid, terrain, seed)
    height = base.height_m
    base.add_waves(grid, terrain.relief, seed, _ROUGHNESS_M, np.inf)
    craters = base.permitted(draw_craters(terrain.craters, grid, seed, base.largest_m))
    albedo = np.ones(grid.n_vertices)
    variation = config.light.albedo_variation
    if variation > 0:
        add_patches(albedo, grid, variation, seed)
        add_rays(albedo, grid, craters, terrain.craters.n_rayed, variation, seed)
    stamped = stamp_craters(height, albedo, grid, craters, variation * brightness(craters), terrain.craters.profile)
    base.add_waves(grid, terrain.relief, seed, 0.0, _ROUGHNESS_M)
    visible = stamped.rim_left >= _LEAST_RIM
    craters, sag = craters.chosen(visible), stamped.sag_m[visible]
    if model is not None and terrain.catalogue is not None:
        real = read_catalogue(Path(terrain.catalogue), model, grid, terrain.craters, resolved_m(model))
        craters, sag = real.joined(craters), np.concatenate([np.zeros(len(real)), sag])
    height -= value_at(height, grid, 0.0, 0.0)
    boulders = draw_boulders(terrain.boulders, grid, craters, seed)
    return Scene(
        seed,
        *_place(config, model),
        grid,
        height.astype(np.float32),
        np.clip(albedo, 0.5, 2.2).astype(np.float32),
        craters,
        measure_rims(height, grid, craters, sag),
        boulders,
        boulders.centre_height_m(value_at(height, grid, boulders.x_m, boulders.y_m)),
        "procedural" if model is None else model.source,
        base.beyond_m == 0,
        view,
    )


def check_ground(config: DatasetConfig, view: ViewEnvelope) -> None:
    """Check grid, relief and input files before the ground is generated. Raises UserError.

    Prints remarks on the elevation model.
    """
    check_levels(config.terrain, view)
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
