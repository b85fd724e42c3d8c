"""Relief of the procedural ground around an elevation model, with the model's statistics.

The statistics are robust standard deviations of second differences of height at several baselines: the median absolute
value divided by 0.6745, which single pits hardly change. They are measured on the model, and on flat ground with only
the configured craters. A self-affine relief is fitted to the part that the craters do not explain.
"""

import functools
from dataclasses import dataclass

import numpy as np

from perilune_render.config.terrain import CratersConfig, ReliefConfig
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.craters.population import draw_craters
from perilune_render.terrain.craters.stamp import stamp_craters
from perilune_render.terrain.elevation.continuation import fade
from perilune_render.terrain.elevation.model import ElevationModel, resolved_m
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.noise import add_waves
from perilune_shared.geometry.frames import Array

_NORMAL = 0.6745
"""Ratio of the median absolute value to the standard deviation of a normal distribution."""
_HURST = np.arange(0.4, 1.01, 0.05)
"""Hurst exponents that the fit tries."""
_LARGEST_TRIAL = 384
"""Largest number of pixels along a side of the trial ground, which has only craters."""


@dataclass(frozen=True, slots=True)
class FittedRelief:
    """Self-affine waves in octaves; amplitudes are a coefficient times wavelength^hurst_exponent."""

    wavelength_m: Array
    """Wavelengths, from the shortest that the model resolves, metres (N,)."""
    amplitude_m: Array
    """Amplitudes of gradient noise (`perilune_render.terrain.noise.add_waves`), metres (N,)."""
    hurst_exponent: float
    """Fitted Hurst exponent."""


def fitted_relief(model: ElevationModel, relief: ReliefConfig, craters: CratersConfig, seed: int) -> FittedRelief:
    """Waves fitted to the model, from the shortest resolved to the longest configured wavelength."""
    n_octaves = int(np.floor(np.log2(relief.longest_wavelength_m / resolved_m(model)))) + 1
    wavelength = relief.longest_wavelength_m / 2.0 ** np.arange(max(n_octaves, 0))
    baselines = 2 ** np.arange(1, max(int(np.log2(min(model.height_m.shape) / 4)), 1) + 1)
    measured = second_differences(np.where(model.known, model.height_m, np.nan), baselines)
    left = measured**2 - second_differences(_cratered(model, craters, seed), baselines) ** 2
    target = np.maximum(left, 0.02 * measured**2)
    if not len(wavelength) or not target.all():
        return FittedRelief(wavelength, np.zeros(len(wavelength)), relief.hurst_exponent)
    response = _response(baselines[:, None] * model.pixel_m / wavelength) ** 2
    best = (np.inf, 0.0, 0.0)
    for hurst in _HURST:
        ratio = np.log(target) - np.log(response @ wavelength ** (2 * hurst))
        best = min(best, (float(np.abs(ratio - np.median(ratio)).sum()), float(hurst), float(np.median(ratio))))
    _, hurst, log_square = best
    return FittedRelief(wavelength, np.exp(log_square / 2) * wavelength**hurst, hurst)


def add_fitted_relief(
    height_m: Array, grid: Grid, fitted: FittedRelief, beyond_m: Array, seed: int, band_m: tuple[float, float]
) -> None:
    """Add the waves of a band of wavelengths to height_m (n_vertices,), in place, beyond the model only.

    `band_m` is the shortest (inclusive) and the longest (exclusive) wavelength, metres. `beyond_m` (n_vertices,) is the
    distance from known ground of the model, metres. The amplitude of a wave grows with this distance as the model's
    relief of the same wavelength fades (`continuation.fade`).
    """
    outside = np.flatnonzero(beyond_m > 0)
    for length, amplitude in zip(fitted.wavelength_m, fitted.amplitude_m, strict=True):
        if band_m[0] <= length < band_m[1] and amplitude > 0:
            waves = np.zeros(grid.n_vertices)
            add_waves(waves, grid, float(length), float(amplitude), stream(seed, "surroundings", length))
            height_m[outside] += waves[outside] * (1 - fade(beyond_m[outside], float(length)) ** 2)


def second_differences(height_m: Array, baselines: np.ndarray) -> Array:
    """Robust standard deviation (B,) of h(x - b) - 2 h(x) + h(x + b) for each baseline b, pixels.

    Differences are taken along both axes of the heights (rows, columns). NaN values are ignored; the result is 0
    without other values.
    """
    deviations = []
    for b in baselines:
        along = [
            np.abs(h[: -2 * b] - 2 * h[b:-b] + h[2 * b :]).ravel() for h in (height_m, height_m.T) if len(h) > 2 * b
        ]
        values = np.concatenate(along) if along else np.empty(0)
        values = values[np.isfinite(values)]
        deviations.append(np.median(values) / _NORMAL if len(values) else 0.0)
    return np.array(deviations)


def _cratered(model: ElevationModel, config: CratersConfig, seed: int) -> Array:
    """Heights (rows, columns), metres, of flat ground with only craters, at the model's pixel size."""
    n_half = min(*model.height_m.shape, _LARGEST_TRIAL) // 2
    grid = Grid.even(n_half * model.pixel_m, n_half)
    height = np.zeros(grid.n_vertices)
    craters = draw_craters(config, grid, derived_seed(seed, "trial craters"))
    stamp_craters(height, np.ones(grid.n_vertices), grid, craters, np.zeros(len(craters)), config.profile)
    return height.reshape(2 * n_half + 1, -1)


def _response(ratio: Array) -> Array:
    """`second_differences` of gradient noise of amplitude 1, for ratios of baseline to wavelength."""
    baselines, deviations = _measured_response()
    return np.interp(ratio, baselines, deviations)


@functools.cache
def _measured_response() -> tuple[Array, Array]:
    wavelength, n_half = 32, 192
    grid = Grid.even(float(n_half), n_half)
    field = np.zeros(grid.n_vertices)
    add_waves(field, grid, float(wavelength), 1.0, np.random.default_rng(1))
    baselines = np.array([1, 2, 4, 6, 8, 11, 16, 22, 32, 45, 64])
    deviations = second_differences(field.reshape(2 * n_half + 1, -1), baselines)
    # Second differences of a smooth wave are proportional to the square of the baseline.
    low = np.array([1 / 64, 1 / 16, 1 / 4])
    return np.concatenate([low / wavelength, baselines / wavelength]), np.concatenate(
        [deviations[0] * low**2, deviations]
    )
