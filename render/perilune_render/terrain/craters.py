"""The crater population of a scene: where, how large, how old, how worn. Plain data, before any height is known.

Each crater's age is uniform between now and the time in which production fills the equilibrium of its size, so that
fresh, worn and nearly erased craters stand together, as in real images; where production has not filled it yet,
between now and the age of the surface (our simplification: production before 3 Gyr ago fell fast). Equilibrium
densities are counts of craters that people could still see, so no crater in equilibrium is drawn more worn than
`_LAST_SEEN_WEAR`.

Craters are ordered by age. As diffusivity grows with size as D^0.9, an order by wear would differ: it would lay a large
young crater before a small old one, which it has in truth removed.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from perilune_render.config_terrain import CratersConfig
from perilune_render.streams import stream
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.profile import fresh_depth_m, fresh_rim_height_m
from perilune_render.terrain.size_frequency import (
    EQUILIBRIA,
    Minimum,
    NeukumProduction,
    SizeFrequency,
    draw_diameters,
    log_bins,
)
from perilune_shared.geometry.frames import Array

ORIGINS = ("primary", "secondary", "elevation model")
"""What `Craters.origin` counts: drawn alone, drawn in a cluster, or read from a catalogue of real ground."""
_LAST_SEEN_WEAR = 0.11
"""K/R^2 at which a crater has lost three quarters of its depth and is hardly counted any more."""
_LARGEST_SECONDARY_M = 30.0
_PER_CLUSTER = 40


@dataclass(frozen=True, slots=True)
class Craters:
    """N craters, oldest first: the order in which they are laid on the ground."""

    x_m: Array
    """Centre, O_L, metres (N,)."""
    y_m: Array
    """Centre, O_L, metres (N,)."""
    diameter_m: Array
    """Rim to rim, metres (N,)."""
    fresh_depth_m: Array
    """Rim to floor when it formed, metres (N,); NaN where not known."""
    rim_height_m: Array
    """Crest over the plain when it formed, metres (N,)."""
    age_myr: Array
    """Time since it formed, Myr (N,); NaN where not known."""
    wear_m2: Array
    """Topographic diffusivity times age, K, square metres (N,)."""
    flat_floor: np.ndarray
    """Whether it formed with a flat floor (N,)."""
    outline: Array
    """Cosine and sine parts of waves 2 to 4 in the rim's radius, over the radius (N, 6)."""
    crest: Array
    """Cosine and sine parts of waves 1 to 3 in the rim's height, over that height (N, 6)."""
    origin: np.ndarray
    """Index into ORIGINS (N,)."""

    def __len__(self) -> int:
        return len(self.x_m)

    def chosen(self, which: np.ndarray) -> "Craters":
        """The craters at some places, or where a mask is true."""
        return Craters(*(getattr(self, field.name)[which] for field in dataclasses.fields(self)))

    def joined(self, other: "Craters") -> "Craters":
        """These craters, then others."""
        names = [field.name for field in dataclasses.fields(self)]
        return Craters(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))

    @classmethod
    def round(
        cls,
        x_m: Array,
        y_m: Array,
        diameter_m: Array,
        fresh_depth_m: Array,
        age_myr: Array,
        wear_m2: Array,
        profile: str = "fassett_thomson",
        origin: str = "primary",
    ) -> "Craters":
        """Perfectly round craters with rounded floors, in the order given; arrays (N,)."""
        n = len(x_m)
        rim = fresh_rim_height_m(diameter_m, fresh_depth_m, profile)
        still = np.zeros((n, 6))
        kind = np.full(n, ORIGINS.index(origin))
        none = np.zeros(n, bool)
        return cls(x_m, y_m, diameter_m, fresh_depth_m, rim, age_myr, wear_m2, none, still, still.copy(), kind)


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
    smallest = config.min_diameter_spacings * float(grid.spacings_m.min())
    share = rng.uniform(config.equilibrium_share.low, config.equilibrium_share.high)
    equilibrium = EQUILIBRIA[config.equilibrium](share=share)
    law = Minimum(NeukumProduction(age_gyr=config.surface_age_gyr), equilibrium)
    edges = log_bins(smallest, max(largest, 1.001 * smallest))
    half_m = np.array([grid.half_width_for(low / config.min_diameter_spacings) for low in edges[:-1]])
    diameter = draw_diameters(law, edges, np.square(2 * half_m), rng)
    if largest <= smallest:
        diameter = diameter[:0]
    n = len(diameter)
    reach = half_m[np.clip(np.searchsorted(edges, diameter, side="right") - 1, 0, len(half_m) - 1)]
    x, y = rng.uniform(-1, 1, (2, n)) * reach
    # Linear production over the last 3 Gyr: the rate is that of the last billion years.
    to_equilibrium = 1000 * _in_bin(equilibrium, diameter) / _in_bin(NeukumProduction(age_gyr=1.0), diameter)
    to_unseen = _LAST_SEEN_WEAR * (diameter / 2) ** 2 / diffusivity_m2_per_myr(diameter)
    surface_myr = 1000 * config.surface_age_gyr
    oldest = np.where(to_equilibrium < surface_myr, np.minimum(to_equilibrium, to_unseen), surface_myr)
    age = rng.random(n) * oldest
    fresh = fresh_depth_m(diameter, config.depth)
    depth = np.maximum(fresh + 0.02 * diameter * np.clip(rng.normal(size=n), -2, 2), 0.08 * diameter)
    x, y, age, clustered = _cluster(x, y, age, oldest, diameter, reach, config.secondary_share, rng)
    flat_floor = rng.random(n) < config.flat_floor_share
    # Slow impacts and floors of rock make shallower craters; by how much is a choice of ours.
    depth = np.where(clustered | flat_floor, 0.75 * depth, depth)
    craters = Craters(
        x,
        y,
        diameter,
        depth,
        fresh_rim_height_m(diameter, depth, config.profile),
        age,
        diffusivity_m2_per_myr(diameter) * age,
        flat_floor,
        config.irregularity * np.clip(rng.normal(0, 0.0035, (n, 6)), -0.008, 0.008),
        config.irregularity * rng.normal(0, 0.06, (n, 6)),
        np.where(clustered, ORIGINS.index("secondary"), ORIGINS.index("primary")),
    )
    return craters.chosen(np.argsort(-age, kind="stable"))


def _cluster(
    x: Array,
    y: Array,
    age: Array,
    oldest: Array,
    diameter: Array,
    reach: Array,
    share: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array, np.ndarray]:
    """Move a share of the small craters into elongated clusters of one age each, as secondaries lie.

    The size-frequency law stays as it is. Sizes and shapes of the clusters are a choice of ours, by eye beside NAC
    images. A crater that would leave the part of the grid that can hold it stays where it was.
    """
    chosen = np.flatnonzero((rng.random(len(x)) < share) & (diameter < _LARGEST_SECONDARY_M))
    clustered = np.zeros(len(x), bool)
    if not len(chosen):
        return x, y, age, clustered
    n_clusters = max(len(chosen) // _PER_CLUSTER, 1)
    # A cluster's size goes with that of its craters: sorted by size, neighbours go together.
    chosen = chosen[np.argsort(diameter[chosen] * rng.uniform(0.5, 2, len(chosen)), kind="stable")]
    cluster = np.minimum(np.arange(len(chosen)) * n_clusters // len(chosen), n_clusters - 1)
    first = np.searchsorted(cluster, np.arange(n_clusters))
    scale = 12 * diameter[chosen[first]] * rng.uniform(0.7, 1.5, n_clusters)
    heading = rng.uniform(0, 2 * np.pi, n_clusters)
    along, across = rng.normal(size=(2, len(chosen))) * np.array([[1.0], [0.35]]) * scale[cluster]
    cos, sin = np.cos(heading)[cluster], np.sin(heading)[cluster]
    new_x = x[chosen[first]][cluster] + along * cos - across * sin
    new_y = y[chosen[first]][cluster] + along * sin + across * cos
    held = np.maximum(np.abs(new_x), np.abs(new_y)) < reach[chosen]
    moved = chosen[held]
    x, y, age = x.copy(), y.copy(), age.copy()
    x[moved], y[moved] = new_x[held], new_y[held]
    # One age for all, at which the smallest of them is not yet gone.
    youngest = np.minimum.reduceat(oldest[chosen], first) * rng.random(n_clusters)
    age[moved] = youngest[cluster][held]
    clustered[moved] = True
    return x, y, age, clustered


def _in_bin(law: SizeFrequency, diameter_m: Array) -> Array:
    """Number in a bin of a tenth of a decade."""
    return law.csfd(diameter_m) - law.csfd(diameter_m * 10**0.1)
