"""The crater population of a scene: places, sizes, ages and wear, as plain data without heights.

A crater's age is drawn uniformly between 0 and the time in which production reaches the equilibrium density of its
size, so that fresh, worn and nearly erased craters occur together, as in real images. If production has not reached
equilibrium, the age is drawn between 0 and the age of the surface (our simplification: before 3 Gyr ago, production
fell rapidly). Equilibrium densities are counts of visible craters, so no crater of a size in equilibrium is drawn with
more wear than `_LARGEST_VISIBLE_WEAR`.

Craters are ordered by age, not by wear: diffusivity grows with size as D^0.9, so in order of wear a large young crater
could come before a small old crater that it has removed.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from perilune_render.config.terrain import CratersConfig
from perilune_render.streams import stream
from perilune_render.terrain.craters.profile import fresh_depth_m, fresh_rim_height_m
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.size_frequency import (
    EQUILIBRIA,
    Minimum,
    NeukumProduction,
    SizeFrequency,
    draw_diameters,
    expected_numbers,
    log_bins,
)
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

ORIGINS = ("primary", "secondary", "elevation model")
"""Values of `Craters.origin`: drawn alone, drawn in a cluster, or read from a catalogue of real ground."""
MAX_CRATERS = 5_000_000
"""Largest expected number of craters in a scene; each needs about 1 kB of memory during stamping and measurement."""
_LARGEST_VISIBLE_WEAR = 0.11
"""Wear K/R^2 at which a crater has lost three quarters of its depth and is rarely counted."""
_LARGEST_SECONDARY_M = 30.0
"""Diameter below which craters can be moved into clusters, metres."""
_PER_CLUSTER = 40
"""Mean number of craters in a cluster."""


@dataclass(frozen=True, slots=True)
class Craters:
    """N craters, oldest first, in the order in which they are stamped on the ground."""

    x_m: Array
    """x of the centres, O_L, metres (N,)."""
    y_m: Array
    """y of the centres, O_L, metres (N,)."""
    diameter_m: Array
    """Diameters from rim to rim, metres (N,)."""
    fresh_depth_m: Array
    """Depths from rim to floor at formation, metres (N,); NaN if unknown."""
    rim_height_m: Array
    """Heights of the rim crest above the plain at formation, metres (N,)."""
    age_myr: Array
    """Times since formation, Myr (N,); NaN if unknown."""
    wear_m2: Array
    """Wear K, topographic diffusivity times age, square metres (N,)."""
    flat_floor: np.ndarray
    """Whether the crater formed with a flat floor (N,)."""
    outline: Array
    """Cosine and sine coefficients of harmonics 2 to 4 of the rim's radius, relative to the radius (N, 6)."""
    crest: Array
    """Cosine and sine coefficients of harmonics 1 to 3 of the rim's height, relative to the height (N, 6)."""
    origin: np.ndarray
    """Index into ORIGINS (N,)."""
    listed_diameter_m: Array
    """Diameters in the catalogue, metres (N,), if its rims are measured in the elevation model; otherwise NaN."""
    rim_rms_share: Array
    """R.m.s. distance of a measured rim from the fitted ellipse, divided by the radius (N,); NaN if not measured."""
    rim_axis_ratio: Array
    """Minor axis of the fitted ellipse divided by its major axis (N,); NaN if not measured."""

    def __len__(self) -> int:
        return len(self.x_m)

    def chosen(self, selection: np.ndarray) -> "Craters":
        """The craters selected by indices or by a mask."""
        return Craters(*(getattr(self, field.name)[selection] for field in dataclasses.fields(self)))

    def joined(self, other: "Craters") -> "Craters":
        """These craters followed by `other`."""
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
    ) -> "Craters":
        """Circular primary craters, in the given order, with bowl-shaped floors.

        The arrays (N,) are the fields of the same names. The profile `fassett_thomson` gives the rim heights.
        """
        n = len(x_m)
        rim = fresh_rim_height_m(diameter_m, fresh_depth_m)
        even = np.zeros((n, 6))
        kind = np.full(n, ORIGINS.index("primary"))
        not_flat = np.zeros(n, bool)
        unknown = [np.full(n, np.nan) for _ in range(3)]
        return cls(
            x_m, y_m, diameter_m, fresh_depth_m, rim, age_myr, wear_m2, not_flat, even, even.copy(), kind, *unknown
        )


def diffusivity_m2_per_myr(diameter_m: Array) -> Array:
    """Topographic diffusivity at the scale of a crater, m^2/Myr.

    It is 5.5 m^2/Myr at 1 km (Fassett & Thomson 2014, doi 10.1002/2014JE004698) and grows with size as D^0.9.
    """
    return 5.5 * (np.asarray(diameter_m) / 1000) ** 0.9


def draw_craters(config: CratersConfig, grid: Grid, seed: int, max_diameter_m: float | None = None) -> Craters:
    """Draw the crater population of a scene from the random seed `seed`.

    A crater is placed only where the grid is fine enough for its size. `max_diameter_m` excludes the sizes that a real
    elevation model already shows.
    """
    rng = stream(seed, "craters")
    share = rng.uniform(config.equilibrium_share.low, config.equilibrium_share.high)
    equilibrium = EQUILIBRIA[config.equilibrium](share=share)
    law = Minimum(NeukumProduction(age_gyr=config.surface_age_gyr), equilibrium)
    smallest, largest = _sizes(config, grid, max_diameter_m)
    edges, half_m = _bins(config, grid, smallest, largest)
    diameter = draw_diameters(law, edges, np.square(2 * half_m), rng)
    if largest <= smallest:
        diameter = diameter[:0]
    n = len(diameter)
    reach = half_m[np.clip(np.searchsorted(edges, diameter, side="right") - 1, 0, len(half_m) - 1)]
    x, y = rng.uniform(-1, 1, (2, n)) * reach
    # Production was linear over the last 3 Gyr: use the rate of the last 1 Gyr.
    to_equilibrium = 1000 * _in_bin(equilibrium, diameter) / _in_bin(NeukumProduction(age_gyr=1.0), diameter)
    to_invisible = _LARGEST_VISIBLE_WEAR * (diameter / 2) ** 2 / diffusivity_m2_per_myr(diameter)
    surface_myr = 1000 * config.surface_age_gyr
    oldest = np.where(to_equilibrium < surface_myr, np.minimum(to_equilibrium, to_invisible), surface_myr)
    age = rng.random(n) * oldest
    fresh = fresh_depth_m(diameter, config.depth)
    depth = np.maximum(fresh + 0.02 * diameter * np.clip(rng.normal(size=n), -2, 2), 0.08 * diameter)
    single = _Single(x, y, diameter, age, oldest, reach)
    x, y, age, clustered = _clustered(single, config.secondary_share, rng)
    flat_floor = rng.random(n) < config.flat_floor_share
    # Secondaries (slow impacts) and craters with rock floors are shallower; the factor is our choice.
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
        *(np.full(n, np.nan) for _ in range(3)),
    )
    return craters.chosen(np.argsort(-age, kind="stable"))


def _sizes(config: CratersConfig, grid: Grid, max_diameter_m: float | None = None) -> tuple[float, float]:
    """Smallest and largest diameter of a population, metres."""
    largest = min(config.max_diameter_m, max_diameter_m or np.inf, grid.extent_m / 3)
    return config.min_diameter_spacings * float(grid.spacings_m.min()), largest


def _bins(config: CratersConfig, grid: Grid, smallest: float, largest: float) -> tuple[Array, Array]:
    """The edges of the size bins (B + 1,), and a half-width for each bin (B,), metres.

    Within this half-width, the ground is fine enough for the bin.
    """
    edges = log_bins(smallest, max(largest, 1.001 * smallest))
    return edges, np.array([grid.half_width_for(low / config.min_diameter_spacings) for low in edges[:-1]])


def check_craters(config: CratersConfig, grid: Grid) -> None:
    """Raise UserError, before drawing, if the craters of a scene would not fit in memory."""
    equilibrium = EQUILIBRIA[config.equilibrium](share=config.equilibrium_share.high)
    law = Minimum(NeukumProduction(age_gyr=config.surface_age_gyr), equilibrium)
    edges, half_m = _bins(config, grid, *_sizes(config, grid))
    number = float(expected_numbers(law, edges, np.square(2 * half_m)).sum())
    if number > MAX_CRATERS:
        expected = f"at most {MAX_CRATERS}: lower equilibrium_share, or raise min_diameter_spacings"
        raise UserError("dataset.terrain.craters", "number", f"about {number:.3g} in a scene", expected)


@dataclass(frozen=True, slots=True)
class _Single:
    """N craters that are drawn independently, before some of them are moved into clusters."""

    x_m: Array
    """x of the centres, O_L, metres (N,)."""
    y_m: Array
    """y of the centres, O_L, metres (N,)."""
    diameter_m: Array
    """Diameters, metres (N,)."""
    age_myr: Array
    """Ages, Myr (N,)."""
    oldest_myr: Array
    """Largest age that can be drawn for the size of each crater, Myr (N,)."""
    reach_m: Array
    """Half-width of the ground with a vertex spacing fine enough for each crater, metres (N,)."""


def _clustered(single: _Single, share: float, rng: np.random.Generator) -> tuple[Array, Array, Array, np.ndarray]:
    """Move a share of the small craters into elongated clusters, which resemble secondary craters.

    Returns x, y, age and whether each crater was moved (N,). The craters of a cluster have one age. The size-frequency
    law does not change. We chose the sizes and shapes of the clusters by eye, in comparison with images of the Narrow
    Angle Camera. A crater is not moved if it would leave the part of the grid that is fine enough for it.
    """
    x, y, age, diameter = single.x_m, single.y_m, single.age_myr, single.diameter_m
    chosen = np.flatnonzero((rng.random(len(x)) < share) & (diameter < _LARGEST_SECONDARY_M))
    clustered = np.zeros(len(x), bool)
    if not len(chosen):
        return x, y, age, clustered
    n_clusters = max(len(chosen) // _PER_CLUSTER, 1)
    # Each cluster consists of craters of similar (randomised) size, since its extent is proportional to their size.
    chosen = chosen[np.argsort(diameter[chosen] * rng.uniform(0.5, 2, len(chosen)), kind="stable")]
    cluster = np.minimum(np.arange(len(chosen)) * n_clusters // len(chosen), n_clusters - 1)
    first = np.searchsorted(cluster, np.arange(n_clusters))
    scale = 12 * diameter[chosen[first]] * rng.uniform(0.7, 1.5, n_clusters)
    heading = rng.uniform(0, 2 * np.pi, n_clusters)
    along, across = rng.normal(size=(2, len(chosen))) * np.array([[1.0], [0.35]]) * scale[cluster]
    cos, sin = np.cos(heading)[cluster], np.sin(heading)[cluster]
    new_x = x[chosen[first]][cluster] + along * cos - across * sin
    new_y = y[chosen[first]][cluster] + along * sin + across * cos
    inside = np.maximum(np.abs(new_x), np.abs(new_y)) < single.reach_m[chosen]
    moved = chosen[inside]
    x, y, age = x.copy(), y.copy(), age.copy()
    x[moved], y[moved] = new_x[inside], new_y[inside]
    # All craters of a cluster have one age, at which all of them are still visible.
    youngest = np.minimum.reduceat(single.oldest_myr[chosen], first) * rng.random(n_clusters)
    age[moved] = youngest[cluster][inside]
    clustered[moved] = True
    return x, y, age, clustered


def _in_bin(law: SizeFrequency, diameter_m: Array) -> Array:
    """Number of craters per square metre from a diameter to a tenth of a decade above it."""
    return law.csfd(diameter_m) - law.csfd(diameter_m * 10**0.1)
