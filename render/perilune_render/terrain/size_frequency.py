"""Crater size-frequency laws: cumulative numbers per square metre above a diameter."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.frames import Array

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


class SizeFrequency(Protocol):
    """Anything with a cumulative number."""

    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Craters per square metre of at least this diameter (metres)."""
        ...


@dataclass(frozen=True, slots=True)
class NeukumProduction:
    """Lunar production function: Neukum, Ivanov & Hartmann 2001, doi 10.1023/A:1011989004263.

    Valid for 10 m to 100 km; below 10 m the slope at 10 m is carried on (our extension).
    """

    age_gyr: float
    """Age of the surface, Gyr."""

    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Craters per square metre of at least this diameter (metres)."""
        d_km = np.asarray(diameter_m, np.float64) / 1000
        at_1_km = 5.44e-14 * np.expm1(6.93 * self.age_gyr) + 8.38e-4 * self.age_gyr
        exponent = _neukum_exponent(np.log10(np.maximum(d_km, 0.01)))
        slope = (_neukum_exponent(np.array(-1.99)) - _neukum_exponent(np.array(-2.0))) / 0.01
        exponent = exponent + np.where(d_km < 0.01, slope * (np.log10(d_km) + 2), 0.0)
        return at_1_km * 10**exponent * 1e-6


def _neukum_exponent(log_d_km: Array) -> Array:
    return sum((a * log_d_km ** (i + 1) for i, a in enumerate(_NEUKUM_2001)), np.zeros_like(log_d_km))


@dataclass(frozen=True, slots=True)
class TraskEquilibrium:
    """Empirical equilibrium of small craters, N(>D) = 10^-1.1 D^-2 per square metre: Trask 1966 (JPL TR 32-800).

    Seen on mare surfaces for some metres to some hundreds of metres. `share` scales it, since counts on other
    ground lie below it.
    """

    share: float = 1.0
    """Density over Trask's."""

    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Craters per square metre of at least this diameter (metres)."""
        return self.share * 10**-1.1 * np.asarray(diameter_m, np.float64) ** -2


@dataclass(frozen=True, slots=True)
class BoulderLaw:
    """Boulders, N(>D) = 3e-4 D^-2.482 per square metre, in use for the VIPER landing area, taken second hand.

    Valid for some decimetres to some metres.
    """

    density: float = 1.0
    """Times the published law."""

    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Boulders per square metre of at least this diameter (metres)."""
        return self.density * 3e-4 * np.asarray(diameter_m, np.float64) ** -2.482


@dataclass(frozen=True, slots=True)
class Minimum:
    """The smaller of two laws, bin by bin: production until equilibrium takes over."""

    first: SizeFrequency
    """A law."""
    second: SizeFrequency
    """Another law."""

    def csfd(self, diameter_m: ArrayLike) -> Array:
        """Craters per square metre of at least this diameter (metres)."""
        return np.minimum(self.first.csfd(diameter_m), self.second.csfd(diameter_m))


def log_bins(min_diameter_m: float, max_diameter_m: float, per_decade: int = 50) -> Array:
    """Edges of diameter bins, evenly spaced in the logarithm (metres)."""
    decades = np.log10(max_diameter_m / min_diameter_m)
    return np.geomspace(min_diameter_m, max_diameter_m, max(2, int(np.ceil(per_decade * decades)) + 1))


def draw_diameters(law: SizeFrequency, edges_m: Array, areas_m2: Array, rng: np.random.Generator) -> Array:
    """Diameters (N,) in metres, largest bin first: Poisson numbers in each bin over that bin's own area.

    edges_m (B + 1,) ascending, areas_m2 (B,). Within a bin the law is taken as a power law.
    """
    cumulative = law.csfd(edges_m)
    numbers = rng.poisson(np.maximum(cumulative[:-1] - cumulative[1:], 0) * areas_m2)
    drawn = []
    for low, high, n_low, n_high, number in zip(
        edges_m[:-1], edges_m[1:], cumulative[:-1], cumulative[1:], numbers, strict=True
    ):
        slope = np.log(n_high / n_low) / np.log(high / low)
        u = rng.random(number)
        drawn.append(low * (1 - u * (1 - (high / low) ** slope)) ** (1 / slope))
    return np.concatenate(drawn[::-1]) if drawn else np.empty(0)
