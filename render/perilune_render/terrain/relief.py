"""Self-affine relief, in addition to the craters.

The slopes of a self-affine surface with Hurst exponent H vary with wavelength as L^(H-1); Cai & Fa 2020 (doi
10.1029/2020JE006429) find H about 0.9 down to metres on the Moon. The relief is a sum of octaves of gradient noise with
amplitudes proportional to L^H. The longest wavelength is configured; the shortest is the shortest that the grid
resolves at each place.
"""

import numpy as np

from perilune_render.config.terrain import ReliefConfig
from perilune_render.streams import stream
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.noise import RMS_SLOPE, add_waves
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array


def finest_wave_m(grid: Grid) -> float:
    """The shortest wavelength of a grid, metres: three of its smallest vertex spacings."""
    return 3 * float(grid.spacings_m.min())


def check_waves(config: ReliefConfig, grid: Grid) -> None:
    """Raise UserError if the longest wavelength is too short for the grid, or below 1 m.

    The configured slope refers to waves down to 1 m (see `add_relief`).
    """
    least_m = max(finest_wave_m(grid), 1.0)
    if config.longest_wavelength_m < least_m:
        raise UserError(
            "configuration",
            "dataset.terrain.relief.longest_wavelength_m",
            config.longest_wavelength_m,
            f"at least {np.ceil(least_m * 100) / 100:g} m (three vertex spacings, but no less than 1 m)",
        )


def add_relief(
    height_m: Array, grid: Grid, config: ReliefConfig, seed: int, shortest_m: float, longest_m: float
) -> None:
    """Add waves of at least `shortest_m` and less than `longest_m` to height_m (n_vertices,), in place.

    The RMS slope of the sum of all octaves down to 1 m is drawn from `config.rms_slope_deg` with `seed`.
    Long waves are added before the craters, which cut them. Short waves are added afterwards, since a worn crater is
    as rough as the ground around it.
    """
    finest = finest_wave_m(grid)
    check_waves(config, grid)
    n_octaves = int(np.ceil(np.log2(config.longest_wavelength_m / min(finest, 1.0))))
    lengths = config.longest_wavelength_m / 2.0 ** np.arange(n_octaves)
    slopes = lengths ** (config.hurst_exponent - 1)
    rms_slope_deg = stream(seed, "relief").uniform(config.rms_slope_deg.low, config.rms_slope_deg.high)
    slopes *= np.tan(np.radians(rms_slope_deg)) / np.sqrt(np.sum(slopes[lengths >= 1] ** 2))
    for length, slope in zip(lengths, slopes, strict=True):
        if max(finest, shortest_m) <= length < longest_m:
            rng = stream(seed, "relief", length)
            add_waves(height_m, grid, float(length), float(slope * length / RMS_SLOPE), rng)
