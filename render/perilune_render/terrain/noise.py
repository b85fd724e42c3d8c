"""Gradient noise: smooth random waves of one wavelength on the graded grid (compiled by numba)."""

from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.grid import Grid, lines_in
from perilune_shared.geometry.frames import Array

RMS_SLOPE = 0.87
"""RMS slope of the noise of `add_waves` with amplitude 1, times the wavelength; measured at 4 million points."""


class _Waves(NamedTuple):
    """A lattice of random gradients, whose cells are one wavelength wide."""

    wavelength: float
    """Side of a cell, metres."""
    half: float
    """Half-width of the square that the lattice covers, metres."""
    shift: Array
    """Column and row of the lattice at the grid's centre (2,)."""
    weights: Array
    """Amplitude on the inner square and on each ring (R + 1,)."""
    gradient_x: Array
    """x of the unit gradients (rows, columns)."""
    gradient_y: Array
    """y of the unit gradients (rows, columns)."""


def add_waves(field: Array, grid: Grid, wavelength_m: float, amplitude: float, rng: np.random.Generator) -> None:
    """Add gradient noise of one wavelength, times `amplitude`, to field (n_vertices,), in place.

    The noise fades where the grid is too coarse: it has full amplitude up to a spacing of 1/6 of the wavelength, half
    the amplitude at 1/3, and amplitude 0 from 1/2.
    """
    shares = np.clip(1.5 - 3 * grid.spacings_m / wavelength_m, 0, 1)
    if not shares.any():
        return
    half = float(grid.half_widths_m[shares > 0].max())
    # Shift the lattice by a random part of a cell, since gradient noise is 0 at the points of its lattice.
    shift = rng.uniform(0, 1, 2)
    n_cells = int(np.ceil(2 * half / wavelength_m)) + 3
    angle = rng.uniform(0, 2 * np.pi, (n_cells, n_cells))
    centre = shift + half / wavelength_m
    waves = _Waves(wavelength_m, half, centre, amplitude * shares, np.cos(angle), np.sin(angle))
    _add_waves(field, grid.n_half, grid.half_widths_m, waves)


@njit()
def _add_waves(field, n_half, half_widths, waves):
    half, wavelength, shift, gx, gy = waves.half, waves.wavelength, waves.shift, waves.gradient_x, waves.gradient_y
    lines = np.empty((2 * n_half + 1 + 4 * len(half_widths), 7))
    count = lines_in((-half, half, -half, half), n_half, half_widths, lines)
    for row in range(count):
        first, number = int(lines[row, 4]), int(lines[row, 5])
        weight = waves.weights[int(lines[row, 6])]
        if weight == 0:
            continue
        u, v = lines[row, 0] / wavelength + shift[0], lines[row, 1] / wavelength + shift[1]
        du, dv = lines[row, 2] / wavelength, lines[row, 3] / wavelength
        for k in range(number):
            x, y = u + k * du, v + k * dv
            # Cell, and position in the cell; corner weights are quintic, so that slope and curvature are continuous.
            i, j = int(x), int(y)
            fx, fy = x - i, y - j
            wx = fx * fx * fx * (fx * (6 * fx - 15) + 10)
            wy = fy * fy * fy * (fy * (6 * fy - 15) + 10)
            low = (gx[j, i] * fx + gy[j, i] * fy) * (1 - wx)
            low += (gx[j, i + 1] * (fx - 1) + gy[j, i + 1] * fy) * wx
            high = (gx[j + 1, i] * fx + gy[j + 1, i] * (fy - 1)) * (1 - wx)
            high += (gx[j + 1, i + 1] * (fx - 1) + gy[j + 1, i + 1] * (fy - 1)) * wx
            field[first + k] += weight * (low * (1 - wy) + high * wy)
