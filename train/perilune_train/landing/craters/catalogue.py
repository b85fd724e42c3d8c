"""Crater catalogues of a landing site, without errors or with the errors of orbiter images."""

from dataclasses import dataclass, replace
from functools import cached_property
from statistics import median

import numpy as np
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array
from perilune_train.landing.craters.neighbours import Grid, grid_of, nearest

MIN_DIAMETER_M = 5.0
"""Default smallest crater diameter, metres, in a catalogue made from a dataset."""
Chosen = NDArray[np.integer] | NDArray[np.bool_]
"""Selection of craters: an index array or a boolean mask."""


@dataclass(frozen=True)
class Catalogue:
    """N craters, each a circle in space."""

    centre_m: Array
    """Rim centres (N, 3), metres, O_L."""
    normal: Array
    """Unit normals of the rim planes (N, 3), O_L."""
    radius_m: Array
    """Rim radii (N,), metres."""
    position_sigma_m: float
    """Standard deviation of a crater's position, per axis, metres."""
    radius_sigma_share: float
    """Standard deviation of a radius, as a share of the radius."""

    def __len__(self) -> int:
        return len(self.radius_m)

    def part(self, chosen: Chosen) -> "Catalogue":
        """The catalogue of the chosen craters only."""
        places = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
        # `take` is many times as fast as indexing.
        centre_m, normal, radius_m = (
            column.take(places, axis=0) for column in (self.centre_m, self.normal, self.radius_m)
        )
        return replace(self, centre_m=centre_m, normal=normal, radius_m=radius_m)

    def ground_m(self, position_m: Array, count: int) -> float:
        """Median height, metres, of the `count` craters horizontally nearest to a position (2,) or (3,), O_L."""
        near = nearest(self._grid, float(position_m[0]), float(position_m[1]), count)
        return median(self.centre_m[near, 2].tolist())

    @cached_property
    def _grid(self) -> Grid:
        return grid_of(self.centre_m[:, :2])


@dataclass(frozen=True, slots=True)
class CatalogueErrors:
    """Errors of a catalogue made from orbiter images."""

    position_sigma_m: float = 1.0
    """Standard deviation of the position, per axis, metres."""
    diameter_sigma_share: float = 0.03
    """Standard deviation of the diameter, as a share of the diameter."""
    missing_share: float = 0.1
    """Share of the real craters that the catalogue lacks."""
    false_share: float = 0.05
    """Share of the catalogue's craters that do not exist."""


def exact_catalogue(dataset: Dataset, scene_id: str, least_diameter_m: float) -> Catalogue:
    """All craters of a scene that have at least the given diameter, largest first, without errors."""
    columns = ["x_m", "y_m", "z_m", "normal_x", "normal_y", "normal_z", "diameter_m"]
    rows = dataset.table("craters", columns, scene_id=scene_id).to_pandas()
    rows = rows[rows["diameter_m"] >= least_diameter_m].sort_values("diameter_m", ascending=False)
    values = rows.to_numpy(np.float64)
    return Catalogue(values[:, :3], values[:, 3:6], values[:, 6] / 2, 0.0, 0.0)


def with_errors(exact: Catalogue, errors: CatalogueErrors, rng: np.random.Generator) -> Catalogue:
    """The catalogue with random errors, some craters missing and some false craters.

    False craters have the sizes of real craters, and random positions within the area of the catalogue.
    """
    kept = exact.part(rng.random(len(exact)) >= errors.missing_share)
    n_false = round(len(kept) * errors.false_share / (1 - errors.false_share))
    model = kept.part(rng.integers(len(kept), size=n_false))
    low, high = exact.centre_m.min(axis=0), exact.centre_m.max(axis=0)
    false_centre = np.column_stack([rng.uniform(low[:2], high[:2], (n_false, 2)), model.centre_m[:, 2]])
    centre = np.concatenate([kept.centre_m, false_centre])
    radius = np.concatenate([kept.radius_m, model.radius_m])
    return Catalogue(
        centre + errors.position_sigma_m * rng.normal(size=centre.shape),
        np.concatenate([kept.normal, model.normal]),
        radius * np.exp(errors.diameter_sigma_share * rng.normal(size=len(radius))),
        errors.position_sigma_m,
        errors.diameter_sigma_share,
    )
