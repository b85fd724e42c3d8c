"""Size-frequency laws of craters and boulders: one class for each published law.

A law gives `csfd`, the cumulative number per square metre of objects with at least a given diameter. Its support,
`min_diameter_m` to `max_diameter_m`, is the range of diameters for which we use the law. The support is not enforced:
the caller of `draw_diameters` chooses the range in which it draws a population.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array

_NEUKUM_2001 = (
    -3.557528,
    0.781027,
    1.021521,
    -0.156012,
    -0.444058,
    0.019977,
    0.086850,
    -0.005874,
    -0.006809,
    8.25e-4,
    5.54e-5,
)
"""Coefficients a_1 to a_11 of log10 N(>D) = a_0 + sum of a_i log10(D / 1 km)^i. `csfd` computes a_0 from the age."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeFrequency(ABC):
    """A size-frequency law over its support."""

    min_diameter_m: float
    """Lower end of the support, metres."""
    max_diameter_m: float
    """Upper end of the support, metres."""

    @abstractmethod
    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Number per square metre of objects with at least this diameter, metres.

        Also defined outside the support.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class NeukumProduction(SizeFrequency):
    """Lunar production function: Neukum, Ivanov & Hartmann 2001, doi 10.1023/A:1011989004263.

    Valid for 10 m to 100 km; below 10 m it is extrapolated with the slope at 10 m (our extension).
    """

    age_gyr: float
    """Age of the surface, Gyr."""
    min_diameter_m: float = 10.0
    max_diameter_m: float = 100_000.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        d_km = np.asarray(diameter_m, np.float64) / 1000
        at_1_km = 5.44e-14 * np.expm1(6.93 * self.age_gyr) + 8.38e-4 * self.age_gyr
        exponent = _neukum_exponent(np.log10(np.maximum(d_km, 0.01)))
        slope = (_neukum_exponent(np.array(-1.99)) - _neukum_exponent(np.array(-2.0))) / 0.01
        exponent = exponent + np.where(d_km < 0.01, slope * (np.log10(d_km) + 2), 0.0)
        return at_1_km * 10**exponent * 1e-6


def _neukum_exponent(log_d_km: Array) -> Array:
    return sum((a * log_d_km ** (i + 1) for i, a in enumerate(_NEUKUM_2001)), np.zeros_like(log_d_km))


@dataclass(frozen=True, slots=True, kw_only=True)
class TraskEquilibrium(SizeFrequency):
    """Empirical equilibrium of small craters, N(>D) = 10^-1.1 D^-2 per square metre.

    Trask 1966 (JPL TR 32-800). Observed on mare surfaces from some metres to some hundreds of metres; the support is 1
    m to 1 km (our extension).
    """

    share: float = 1.0
    """Density as a multiple of the law. Counts on ground other than mare are lower than the law."""
    min_diameter_m: float = 1.0
    max_diameter_m: float = 1000.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        return self.share * 10**-1.1 * np.asarray(diameter_m, np.float64) ** -2


@dataclass(frozen=True, slots=True, kw_only=True)
class MintonEquilibrium(SizeFrequency):
    """Equilibrium of small craters on a mare, N(>D) = 0.0336 D^-2 per square metre.

    Minton et al. 2019, doi 10.1016/j.icarus.2019.02.021. The support is taken from Trask's law.
    """

    share: float = 1.0
    """Density as a multiple of the law."""
    min_diameter_m: float = 1.0
    max_diameter_m: float = 1000.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        return self.share * 0.0336 * np.asarray(diameter_m, np.float64) ** -2


@dataclass(frozen=True, slots=True, kw_only=True)
class ViperEquilibrium(SizeFrequency):
    """Craters of the VIPER landing area, N(>D) = 29174 D^-1.92 per km^2 up to 80 m.

    Above 80 m the law is extrapolated (our extension). The extrapolation matters for old surfaces: the production
    function is above this law for diameters up to 74 m at an age of 1 Gyr, but up to 263 m at 3.5 Gyr. The law was
    taken from a summary of the literature; its paper is unknown.
    """

    share: float = 1.0
    """Density as a multiple of the law."""
    min_diameter_m: float = 1.0
    max_diameter_m: float = 80.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        return self.share * 0.029174 * np.asarray(diameter_m, np.float64) ** -1.92


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangE4Equilibrium(SizeFrequency):
    """Craters marked by people in 12 Narrow Angle Camera images of the Chang'e-4 site, counted by us.

    Relative to Trask's law the density is 1.22 up to 6 m and 0.57 from 24 m, with a power law between the two. The fit
    uses craters of 6 to 50 m and is extrapolated beyond (our extension). The marked craters were published with Yang et
    al., CraterDANet (IEEE TGRS). The ground sampling of the images is not recorded; we assumed 0.75 m. People do not
    mark nearly erased craters, so a population that includes them needs a `share` of about 1.3.
    """

    share: float = 1.0
    """Density as a multiple of the law."""
    min_diameter_m: float = 1.0
    max_diameter_m: float = 1000.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        d = np.asarray(diameter_m, np.float64)
        over_trask = np.exp(np.interp(np.log(d), np.log([6.0, 24.0]), np.log([1.22, 0.57])))
        return self.share * over_trask * 10**-1.1 * d**-2


@dataclass(frozen=True, slots=True, kw_only=True)
class BoulderLaw(SizeFrequency):
    """Boulders of the VIPER landing area, N(>D) = 3e-4 D^-2.482 per square metre.

    The law was taken from a summary of the literature; its paper is unknown.
    """

    density: float = 1.0
    """Density as a multiple of the law."""
    min_diameter_m: float = 0.2
    max_diameter_m: float = 5.0

    def csfd(self, diameter_m: ArrayLike) -> Array:
        return self.density * 3e-4 * np.asarray(diameter_m, np.float64) ** -2.482


@dataclass(frozen=True, slots=True, init=False)
class Minimum(SizeFrequency):
    """The smaller of two laws, such as production and equilibrium, over their common support."""

    first: SizeFrequency
    """First law."""
    second: SizeFrequency
    """Second law."""

    def __init__(self, first: SizeFrequency, second: SizeFrequency):
        object.__setattr__(self, "first", first)
        object.__setattr__(self, "second", second)
        object.__setattr__(self, "min_diameter_m", max(first.min_diameter_m, second.min_diameter_m))
        object.__setattr__(self, "max_diameter_m", min(first.max_diameter_m, second.max_diameter_m))

    def csfd(self, diameter_m: ArrayLike) -> Array:
        return np.minimum(self.first.csfd(diameter_m), self.second.csfd(diameter_m))


Equilibrium = TraskEquilibrium | MintonEquilibrium | ViperEquilibrium | ChangE4Equilibrium
EQUILIBRIA: dict[str, type[Equilibrium]] = {
    "trask": TraskEquilibrium,
    "minton": MintonEquilibrium,
    "viper": ViperEquilibrium,
    "chang_e_4": ChangE4Equilibrium,
}


def log_bins(min_diameter_m: float, max_diameter_m: float, per_decade: int = 50) -> Array:
    """Edges (B + 1,) of diameter bins, metres, evenly spaced in the logarithm."""
    decades = np.log10(max_diameter_m / min_diameter_m)
    return np.geomspace(min_diameter_m, max_diameter_m, max(2, int(np.ceil(per_decade * decades)) + 1))


def expected_numbers(law: SizeFrequency, edges_m: Array, areas_m2: Array) -> Array:
    """Expected number of objects (B,) in size bins with edges_m (B + 1,), on the areas areas_m2 (B,)."""
    cumulative = law.csfd(edges_m)
    return np.maximum(cumulative[:-1] - cumulative[1:], 0) * areas_m2


def draw_diameters(law: SizeFrequency, edges_m: Array, areas_m2: Array, rng: np.random.Generator) -> Array:
    """Draw diameters (N,), metres, largest bin first, with a Poisson-distributed number in each bin.

    edges_m (B + 1,) is ascending; areas_m2 (B,) holds the area for each bin. Within a bin the law is approximated by a
    power law.
    """
    cumulative = law.csfd(edges_m)
    numbers = rng.poisson(expected_numbers(law, edges_m, areas_m2))[::-1]
    low, high = np.repeat(edges_m[-2::-1], numbers), np.repeat(edges_m[:0:-1], numbers)
    n_low, n_high = np.repeat(cumulative[-2::-1], numbers), np.repeat(cumulative[:0:-1], numbers)
    slope = np.log(n_high / n_low) / np.log(high / low)
    u = rng.random(len(low))
    return low * (1 - u * (1 - (high / low) ** slope)) ** (1 / slope)
