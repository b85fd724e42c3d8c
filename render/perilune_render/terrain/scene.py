"""A scene: the whole ground of one site as plain data."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_render.config import DatasetConfig, FlightConfig
from perilune_render.terrain.albedo import add_patches, add_rays, brightness
from perilune_render.terrain.boulders import Boulders, draw_boulders
from perilune_render.terrain.catalogue import read_catalogue
from perilune_render.terrain.craters import Craters, draw_craters
from perilune_render.terrain.elevation import ElevationModel, base_heights, read_elevation
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.measure import Rims, measure_rims, value_at
from perilune_render.terrain.relief import add_relief
from perilune_render.terrain.stamp import stamp_craters
from perilune_shared.camera import Camera
from perilune_shared.frames import Array

_RESOLVED_PIXELS = 4.0
_ROUGHNESS_M = 100.0
"""Shorter waves lie on top of the craters."""
_LEAST_RIM = 0.3
"""A crater of whose rim younger craters have left less than this share is no crater any more."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Ground, craters and boulders of one site, in O_L."""

    seed: int
    """Of the scene's own streams."""
    latitude_deg: float
    """Of the site, degrees."""
    longitude_deg: float
    """Of the site, degrees."""
    grid: Grid
    """Where the vertices stand."""
    height_m: np.ndarray
    """Height of the vertices (n_vertices,) float32, metres; the site is at 0."""
    albedo: np.ndarray
    """Factor on the reflectance (n_vertices,) float32, about 1."""
    craters: Craters
    """Real ones of a catalogue, then those that younger ones have not removed, oldest first; crater_id is the place."""
    rims: Rims
    """The same craters as found on the finished ground."""
    boulders: Boulders
    """Boulders; the boulder_id is the place in this order."""
    boulder_z_m: Array
    """Height of the boulders' centres, metres."""
    dem_source: str
    """Elevation model, or 'procedural'."""


def grow_scene(config: DatasetConfig, camera: Camera, flight: FlightConfig, seed: int) -> Scene:
    """Grow the scene of a seed: base, relief, craters from the oldest to the youngest, boulders."""
    terrain = config.terrain
    grid = graded_grid(config, camera, flight)
    model = read_elevation(Path(terrain.dem)) if terrain.dem is not None else None
    height = np.zeros(grid.n_vertices) if model is None else base_heights(model, grid)[0]
    resolved = None if model is None else resolved_m(model)
    longest = np.inf if resolved is None else resolved
    add_relief(height, grid, terrain.relief, seed, _ROUGHNESS_M, longest)
    craters = draw_craters(terrain.craters, grid, seed, resolved)
    albedo = np.ones(grid.n_vertices)
    variation = config.light.albedo_variation
    if variation > 0:
        add_patches(albedo, grid, variation, seed)
        add_rays(albedo, grid, craters, terrain.craters.n_rayed, variation, seed)
    laid = stamp_craters(height, albedo, grid, craters, variation * brightness(craters), terrain.craters.profile)
    add_relief(height, grid, terrain.relief, seed, 0.0, min(_ROUGHNESS_M, longest))
    kept = laid.rim_left >= _LEAST_RIM
    craters, sag = craters.chosen(kept), laid.sag_m[kept]
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
    )


def check_ground(config: DatasetConfig, camera: Camera, flight: FlightConfig) -> None:
    """Raises UserError on faults of the files that the ground is made from: they must show before the work begins."""
    grid = graded_grid(config, camera, flight)
    if config.terrain.dem is not None:
        model = read_elevation(Path(config.terrain.dem))
        if config.terrain.catalogue is not None:
            read_catalogue(Path(config.terrain.catalogue), model, grid, config.terrain.craters, resolved_m(model))


def resolved_m(model: ElevationModel) -> float:
    """Diameter in metres from which an elevation model shows a crater: four pixels. Smaller ones are added."""
    return _RESOLVED_PIXELS * model.pixel_m


def _place(config: DatasetConfig, model: ElevationModel | None) -> tuple[float, float]:
    if model is None:
        return config.terrain.latitude_deg, config.terrain.longitude_deg
    return model.latitude_deg, model.longitude_deg
