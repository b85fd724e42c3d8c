"""Gradient noise: smooth random waves of one scale, evaluated at any place (compiled by numba)."""

import numba
import numpy as np

from perilune_shared.frames import Array

RMS_SLOPE = 0.87
"""Root mean square slope times wavelength of `add_waves` with amplitude 1, measured over 4 million places."""


def add_waves(
    field: Array,
    coordinates_m: Array,
    wavelength_m: float,
    amplitude: float,
    seed: int,
    finest_m: float = 0.0,
) -> None:
    """Add amplitude times gradient noise of a wavelength to field (n, n; rows are y), in place.

    Where the grid is too wide to hold the wave (spacing above a third of it) the wave fades out. `finest_m` widens
    every spacing to at least itself.
    """
    steps = np.gradient(coordinates_m)
    held = np.clip(1.5 - 3 * np.maximum(steps, finest_m) / wavelength_m, 0, 1)
    _add_waves(field, coordinates_m / wavelength_m, held, amplitude, np.uint64(seed))


@numba.njit(cache=True)
def _corner(i, j, seed):
    """Gradient at a lattice corner, from a mixed integer hash (the finaliser of SplitMix64)."""
    z = seed + np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    angle = np.float64(z >> np.uint64(11)) * (2 * np.pi / 9007199254740992.0)
    return np.cos(angle), np.sin(angle)


@numba.njit(cache=True)
def _add_waves(field, u, held, amplitude, seed):
    n = len(u)
    cell_of = np.floor(u).astype(np.int64)
    first, last = cell_of[0], cell_of[-1] + 1
    width = last - first + 1
    gx = np.empty((2, width))
    gy = np.empty((2, width))
    loaded = first - 10
    for j in range(n):
        if held[j] <= 0:
            continue
        cell_y = cell_of[j]
        if cell_y != loaded:
            for b in range(2):
                for a in range(width):
                    gx[b, a], gy[b, a] = _corner(first + a + 4194304, cell_y + b + 4194304, seed)
            loaded = cell_y
        fy = u[j] - cell_y
        wy = fy * fy * fy * (fy * (6 * fy - 15) + 10)
        for i in range(n):
            weight = held[i] * held[j]
            if weight <= 0:
                continue
            a = cell_of[i] - first
            fx = u[i] - cell_of[i]
            wx = fx * fx * fx * (fx * (6 * fx - 15) + 10)
            low = (gx[0, a] * fx + gy[0, a] * fy) * (1 - wx) + (gx[0, a + 1] * (fx - 1) + gy[0, a + 1] * fy) * wx
            high = (gx[1, a] * fx + gy[1, a] * (fy - 1)) * (1 - wx)
            high += (gx[1, a + 1] * (fx - 1) + gy[1, a + 1] * (fy - 1)) * wx
            field[j, i] += amplitude * weight * (low * (1 - wy) + high * wy)
