"""The ground before craters: flat, or an elevation model and its surroundings."""

from dataclasses import dataclass

import numpy as np

from perilune_render.config.terrain import ReliefConfig, TerrainConfig
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.profile import REACH
from perilune_render.terrain.elevation.model import (
    ElevationModel,
    base_heights,
    beyond_m,
    raster_places,
    refuse_unseen,
    resolved_m,
)
from perilune_render.terrain.elevation.surroundings import FittedRelief, add_fitted_relief, fitted_relief
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.relief import add_relief
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class Base:
    """The ground before craters: flat, or an elevation model and its surroundings."""

    height_m: Array
    """Heights (n_vertices,), metres, modified in place."""
    beyond_m: Array
    """Distances (n_vertices,) to the nearest ground with a height in the model, metres; infinite without a model."""
    model: ElevationModel | None
    """The elevation model, if any."""
    surroundings: FittedRelief | None
    """Relief of the procedural ground beyond the model, if there is such ground."""

    @property
    def largest_m(self) -> float | None:
        """Largest diameter of generated craters, metres; None to use the configured value.

        If the whole ground is in the model, the model already shows the larger craters.
        """
        return None if self.model is None or self.surroundings is not None else resolved_m(self.model)

    def add_waves(self, grid: Grid, relief: ReliefConfig, seed: int, shortest_m: float, longest_m: float) -> None:
        """Add relief with wavelengths of at least `shortest_m` and less than `longest_m`, metres.

        On the elevation model only wavelengths that it does not resolve are added.
        """
        resolved = np.inf if self.model is None else resolved_m(self.model)
        add_relief(self.height_m, grid, relief, seed, shortest_m, min(longest_m, resolved))
        if self.surroundings is not None:
            add_fitted_relief(self.height_m, grid, self.surroundings, self.beyond_m, seed, (shortest_m, longest_m))

    def permitted(self, craters: Craters) -> Craters:
        """The craters to stamp: those too small for the model to resolve, and larger ones beyond the model."""
        if self.model is None or self.surroundings is None:
            return craters
        large = craters.diameter_m > resolved_m(self.model)
        column, row = raster_places(self.model, craters.x_m[large], craters.y_m[large])
        allowed = np.ones(len(craters), bool)
        allowed[large] = beyond_m(self.model, column, row) >= REACH * craters.diameter_m[large] / 2
        return craters.chosen(allowed)


def base_of(model: ElevationModel | None, grid: Grid, terrain: TerrainConfig, seed: int) -> Base:
    """The ground before craters: an elevation model and its surroundings, or flat ground."""
    if model is None:
        return Base(np.zeros(grid.n_vertices), np.full(grid.n_vertices, np.inf), None, None)
    refuse_unseen(model, grid, terrain.elevation)
    height, beyond = base_heights(model, grid, terrain.elevation.outside)
    if not np.isfinite(height).all():
        raise UserError(model.source, "heights", "ground without a height", "an elevation model with a finite ground")
    needed = terrain.elevation.outside == "procedural" and bool((beyond > 0).any())
    surroundings = fitted_relief(model, terrain.relief, terrain.craters, seed) if needed else None
    return Base(height, beyond, model, surroundings)
