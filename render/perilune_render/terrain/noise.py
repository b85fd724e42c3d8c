"""Gradient noise: smooth random waves of one wavelength on the graded grid (compiled by numba)."""

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import Grid, lines_in
from perilune_shared.geometry.frames import Array

RMS_SLOPE = 0.87
"""RMS slope times wavelength of `add_waves` with amplitude 1, measured at 4 million points."""


def add_waves(
    field: Array,
    grid: Grid,
    wavelength_m: float,
    amplitude: float,
    rng: np.random.Generator,
    whole: Grid | None = None,
) -> None:
    """Add amplitude times gradient noise of a wavelength to field (n_vertices,), in place.

    The wave fades where the grid is too coarse for it: full amplitude up to a spacing of a sixth of the wavelength,
    half at a third, none from a half. If `grid` is a level, the wave is that of the grid `whole`.
    """
    shares = _shares(grid, wavelength_m)
    if not shares.any():
        return
    half, own_half = _half_width(whole or grid, wavelength_m), _half_width(grid, wavelength_m)
    if half == 0:
        return
    centre = np.array([grid.centre_x_m, grid.centre_y_m])
    # Shift the lattice by a random part of a cell, since gradient noise is 0 at the points of its lattice.
    shift = rng.uniform(0, 1, 2)
    n_cells = int(np.ceil(2 * half / wavelength_m)) + 3
    angle = rng.uniform(0, 2 * np.pi, (n_cells, n_cells))
    if own_half > half:
        # A level may be finer than `whole` outside the ground in view: repeat the lattice there.
        n_more = int(np.ceil((own_half - half) / wavelength_m))
        angle = np.pad(angle, n_more, mode="wrap")
        half += n_more * wavelength_m
    _add_waves(
        field,
        grid.n_half,
        grid.half_widths_m,
        half,
        centre,
        wavelength_m,
        shift + (half + centre) / wavelength_m,
        shares,
        amplitude,
        np.cos(angle),
        np.sin(angle),
    )


def _shares(grid: Grid, wavelength_m: float) -> Array:
    """Share of the amplitude that each ring of a grid carries (n_rings + 1,)."""
    return np.clip(1.5 - 3 * grid.spacings_m / wavelength_m, 0, 1)


def _half_width(grid: Grid, wavelength_m: float) -> float:
    """Distance max(|x|, |y|) from the site up to which a grid carries a wave, metres."""
    carried = _shares(grid, wavelength_m) > 0
    return grid.off_site_m + float(grid.half_widths_m[carried].max()) if carried.any() else 0.0


@njit()
def _add_waves(field, n_half, half_widths, half, centre, wavelength, shift, shares, amplitude, gx, gy):
    lines = np.empty((2 * n_half + 1 + 4 * len(half_widths), 7))
    x, y = centre
    count = lines_in(-half - x, half - x, -half - y, half - y, n_half, half_widths, lines)
    for row in range(count):
        first, number = int(lines[row, 4]), int(lines[row, 5])
        weight = amplitude * shares[int(lines[row, 6])]
        if weight == 0:
            continue
        u, v = lines[row, 0] / wavelength + shift[0], lines[row, 1] / wavelength + shift[1]
        du, dv = lines[row, 2] / wavelength, lines[row, 3] / wavelength
        for k in range(number):
            p, q = u + k * du, v + k * dv
            i, j = int(p), int(q)
            fx, fy = p - i, q - j
            wx = fx * fx * fx * (fx * (6 * fx - 15) + 10)
            wy = fy * fy * fy * (fy * (6 * fy - 15) + 10)
            low = (gx[j, i] * fx + gy[j, i] * fy) * (1 - wx)
            low += (gx[j, i + 1] * (fx - 1) + gy[j, i + 1] * fy) * wx
            high = (gx[j + 1, i] * fx + gy[j + 1, i] * (fy - 1)) * (1 - wx)
            high += (gx[j + 1, i + 1] * (fx - 1) + gy[j + 1, i + 1] * (fy - 1)) * wx
            field[first + k] += weight * (low * (1 - wy) + high * wy)
