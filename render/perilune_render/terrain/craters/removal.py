"""Which craters are removed from the ground, and how far from them the ground changes."""

from collections.abc import Sequence

import numpy as np

from perilune_render.terrain.craters.population import Craters
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

REACH_RADII = 4.0
"""Distance from a removed crater beyond which no height changes, in crater radii. Profiles end at 3 radii. Younger
craters on the changed ground change heights farther out, by less than a millimetre; this is neglected."""


def indices_of(crater_ids: Sequence[int], n_real: int, n_craters: int, seed: int) -> np.ndarray:
    """Indices, ascending and unique, of the craters to remove from a scene with `n_craters`.

    The first `n_real` craters are part of an elevation model. Raises UserError if an id is unknown or belongs to one of
    these craters.
    """
    for crater_id in crater_ids:
        if not n_real <= crater_id < n_craters:
            expected = f"generated craters of the scene with seed {seed}, {n_real} to {n_craters - 1}"
            raise UserError("configuration", "dataset.counterfactual.removed", crater_id, expected)
    return np.unique(np.array(crater_ids, np.int64))


def near(x_m: Array | float, y_m: Array | float, removed: Craters) -> np.ndarray:
    """Whether positions (N,) on O_L's plane, metres, are within REACH_RADII of a removed crater."""
    within = np.zeros(np.shape(x_m), bool)
    for x, y, diameter in zip(removed.x_m, removed.y_m, removed.diameter_m, strict=True):
        within |= np.square(x_m - x) + np.square(y_m - y) <= (REACH_RADII * diameter / 2) ** 2
    return within
