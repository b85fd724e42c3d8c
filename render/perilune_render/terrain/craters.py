"""The crater population of a scene: where, how large, how old, how worn. Plain data, before any height is known.

Each crater's age is uniform between now and the time in which production fills the equilibrium of its size, so that
fresh, worn and nearly erased craters stand together, as in real images. Equilibrium densities are counts of craters
that people could still see, so no crater in equilibrium is drawn more worn than `_LAST_SEEN_WEAR`.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from perilune_render.config import CratersConfig
from perilune_render.streams import stream
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.profile import fresh_depth_ratio
from perilune_render.terrain.size_frequency import (
    Minimum,
    NeukumProduction,
    TraskEquilibrium,
    draw_diameters,
    log_bins,
)
from perilune_shared.frames import Array

_LAST_SEEN_WEAR = 0.15
"""K/R^2 at which a crater has lost five sixths of its depth and is hardly counted any more."""


@dataclass(frozen=True, slots=True)
class Craters:
    """N craters, most worn first: the order in which they are laid on the ground."""

    x_m: Array
    """Centre, O_L, metres (N,)."""
    y_m: Array
    """Centre, O_L, metres (N,)."""
    diameter_m: Array
    """Rim to rim, metres (N,)."""
    fresh_depth_m: Array
    """Rim to floor when it formed, metres (N,)."""
    age_myr: Array
    """Time since it formed, Myr (N,)."""
    wear_m2: Array
    """Topographic diffusivity times age, K, square metres (N,)."""

    def __len__(self) -> int:
        return len(self.x_m)

    def chosen(self, which: np.ndarray) -> "Craters":
        """The craters at some places, or where a mask is true."""
        return Craters(*(getattr(self, field.name)[which] for field in dataclasses.fields(self)))


def diffusivity_m2_per_myr(diameter_m: Array) -> Array:
    """Topographic diffusivity at the scale of a crater, m^2/Myr.

    5.5 m^2/Myr at 1 km (Fassett & Thomson 2014, doi 10.1002/2014JE004698); its fall with size as D^0.9 is taken second
    hand, without a primary source.
    """
    return 5.5 * (np.asarray(diameter_m) / 1000) ** 0.9


def draw_craters(config: CratersConfig, grid: Grid, seed: int, max_diameter_m: float | None = None) -> Craters:
    """The population of a scene with seed `seed`.

    Each size is laid only where the grid is fine enough to hold it. `max_diameter_m` leaves out what a real elevation
    model already shows.
    """
    rng = stream(seed, "craters")
    largest = min(config.max_diameter_m, max_diameter_m or np.inf, grid.extent_m / 3)
    smallest = config.min_diameter_spacings * float(np.diff(grid.coordinates_m).min())
    share = rng.uniform(config.equilibrium_share.low, config.equilibrium_share.high)
    equilibrium = TraskEquilibrium(share)
    law = Minimum(NeukumProduction(config.surface_age_gyr), equilibrium)
    if largest <= smallest:
        return Craters(*(np.empty(0) for _ in range(6)))
    edges = log_bins(smallest, largest)
    half_m = np.array([grid.half_width_for(low / config.min_diameter_spacings) for low in edges[:-1]])
    diameter = draw_diameters(law, edges, np.square(2 * half_m), rng)
    bins = np.clip(np.searchsorted(edges, diameter, side="right") - 1, 0, len(half_m) - 1)
    x, y = rng.uniform(-1, 1, (2, len(diameter))) * half_m[bins]
    # Linear production over the last 3 Gyr: the rate is that of the last billion years.
    per_gyr = NeukumProduction(1.0)
    to_equilibrium = 1000 * _in_bin(equilibrium, diameter) / _in_bin(per_gyr, diameter)
    to_unseen = _LAST_SEEN_WEAR * (diameter / 2) ** 2 / diffusivity_m2_per_myr(diameter)
    surface_myr = 1000 * config.surface_age_gyr
    oldest = np.where(to_equilibrium < surface_myr, np.minimum(to_equilibrium, to_unseen), surface_myr)
    age = rng.random(len(diameter)) * oldest
    ratio = np.clip(rng.normal(fresh_depth_ratio(diameter), 0.015), 0.05, 0.25)
    wear = diffusivity_m2_per_myr(diameter) * age
    order = np.argsort(-wear, kind="stable")
    return Craters(*(values[order] for values in (x, y, diameter, ratio * diameter, age, wear)))


def _in_bin(law: TraskEquilibrium | NeukumProduction, diameter_m: Array) -> Array:
    """Number in a bin of a tenth of a decade."""
    return law.csfd(diameter_m) - law.csfd(diameter_m * 10**0.1)
