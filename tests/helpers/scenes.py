"""Small scenes and configurations of the renderer for tests."""

import numpy as np

from perilune_render.config.dataset import DatasetConfig, KindConfig
from perilune_render.terrain.boulders import Boulders
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.rims import Rims, measure_rims
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import Scene

NO_BOULDERS = Boulders(np.empty(0), np.empty(0), np.empty(0), np.empty(0, np.int64), np.empty((0, 4)))


def config_with(**changes) -> DatasetConfig:
    """Return the default configuration with some sections replaced."""
    kind = KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=4, split_by="scene")
    return DatasetConfig(**{"detect": kind, "nav": kind, **changes})


def round_craters(rows, wear=1e-3) -> Craters:
    """Make craters, in order, from rows of x, y, diameter, depth / diameter and optionally wear K/R^2."""
    columns = np.atleast_2d(np.asarray(rows, float)).T
    x, y, diameter, ratio = columns[:4]
    ratio_k = columns[4] if len(columns) > 4 else np.full_like(x, wear)
    return Craters.round(x, y, diameter, ratio * diameter, np.zeros_like(x), ratio_k * (diameter / 2) ** 2)


def flat_scene(extent_m: float, n: int, craters: Craters | None = None, height_m: np.ndarray | None = None) -> Scene:
    """Make a scene on a uniform grid of n x n vertices (n odd), flat unless heights (n, n; rows are y) are given."""
    grid = Grid.even(extent_m / 2, (n - 1) // 2)
    height = np.zeros(n * n) if height_m is None else np.ravel(height_m)
    none = craters if craters is not None else round_craters(np.empty((0, 4)))
    rims = measure_rims(height, grid, none) if len(none) else Rims(np.empty(0), np.empty((0, 3)), np.empty(0))
    real = np.zeros(n * n, bool)
    return Scene(1, 0.0, 0.0, grid, height, np.ones(n * n), none, rims, NO_BOULDERS, np.empty(0), "procedural", real)
