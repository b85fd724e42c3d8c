"""A scene: the whole ground of one site as plain data."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_render.config import DatasetConfig, FlightConfig
from perilune_render.streams import derived_seed
from perilune_render.terrain.boulders import Boulders, draw_boulders
from perilune_render.terrain.craters import Craters, draw_craters
from perilune_render.terrain.elevation import ElevationModel, base_heights, read_elevation
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.measure import Rims, height_at, measure_rims
from perilune_render.terrain.noise import add_waves
from perilune_render.terrain.relief import add_relief
from perilune_render.terrain.stamp import rim_left, stamp_craters
from perilune_shared.camera import Camera
from perilune_shared.frames import Array

_RESOLVED_PIXELS = 4.0
"""An elevation model shows craters of at least this many pixels across; smaller ones are added."""
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
    height_m: Array
    """Height of the vertices, rows are y (n, n), metres; the site is at 0."""
    albedo: Array
    """Factor on the reflectance (n, n), about 1."""
    craters: Craters
    """Those that younger ones have not removed, in the order in which they were laid; crater_id is the place in it."""
    rims: Rims
    """The same craters as found on the finished ground."""
    boulders: Boulders
    """Boulders; the boulder_id is the place in this order."""
    boulder_z_m: Array
    """Height of the boulders' centres, metres."""
    dem_source: str
    """Elevation model, or 'procedural'."""


def grow_scene(config: DatasetConfig, camera: Camera, flight: FlightConfig, seed: int) -> Scene:
    """Grow the scene of a seed: base, relief, craters from the most worn to the freshest, boulders."""
    terrain = config.terrain
    grid = graded_grid(config, camera, flight)
    model = read_elevation(Path(terrain.dem)) if terrain.dem is not None else None
    n = len(grid.coordinates_m)
    height = np.zeros((n, n)) if model is None else base_heights(model, grid)[0]
    resolved = None if model is None else _RESOLVED_PIXELS * model.pixel_m
    longest = np.inf if resolved is None else resolved
    add_relief(height, grid, terrain.relief, seed, _ROUGHNESS_M, longest)
    craters = draw_craters(terrain.craters, grid, seed, resolved)
    albedo = np.ones((n, n))
    variation = config.light.albedo_variation
    if variation > 0:
        for length, amplitude in ((600.0, 0.10), (150.0, 0.06), (40.0, 0.05)):
            add_waves(
                albedo,
                grid.coordinates_m + 0.37 * length,
                length,
                amplitude * variation,
                derived_seed(seed, "albedo", length),
            )
    sag = stamp_craters(height, albedo, grid, craters, variation * _brightness(craters))
    add_relief(height, grid, terrain.relief, seed, 0.0, min(_ROUGHNESS_M, longest))
    if len(craters):
        kept = rim_left(craters) >= _LEAST_RIM
        craters, sag = craters.chosen(kept), sag[kept]
    height -= height_at(height, grid, np.zeros(1), np.zeros(1))
    boulders = draw_boulders(terrain.boulders, grid, craters, seed)
    return Scene(
        seed,
        *_place(config, model),
        grid,
        height,
        np.clip(albedo, 0.5, 1.8),
        craters,
        measure_rims(height, grid, craters, sag),
        boulders,
        boulders.centre_height_m(height_at(height, grid, boulders.x_m, boulders.y_m)),
        "procedural" if model is None else model.source,
    )


def _place(config: DatasetConfig, model: ElevationModel | None) -> tuple[float, float]:
    if model is None:
        return config.terrain.latitude_deg, config.terrain.longitude_deg
    return model.latitude_deg, model.longitude_deg


def _brightness(craters: Craters) -> Array:
    """Relative brightening of a crater and its ejecta: fresh material is bright and darkens as it wears.

    Half a magnitude at most, gone where the crater has lost about half of its depth; a choice of ours, set by eye
    beside NAC images, since published maturity trends are for far larger craters.
    """
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    return 0.35 * np.exp(-wear / 0.006)
