"""Albedo of the ground: patches, bright young craters with their ejecta, and rays.

Fresh material is brighter than the mature soil around it and darkens with age. We chose brightness and extent by eye,
in comparison with images of the Narrow Angle Camera, since published maturity trends apply to much larger craters.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.streams import stream
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.grid import Grid, lines_in
from perilune_render.terrain.noise import add_waves
from perilune_shared.geometry.frames import Array

_PATCHES = ((600.0, 0.10), (150.0, 0.07), (40.0, 0.05), (12.0, 0.04), (4.0, 0.03))
"""Wavelength, metres, and relative amplitude of each layer of patches."""
RAYS_REACH = 9.0
"""Length of the longest ray from the centre, in crater radii."""
RAYED_WEAR = 0.004
"""Smallest wear K/R^2 of craters that cannot have rays; K is `Craters.wear_m2` and R the radius."""


@dataclass(frozen=True, slots=True)
class RayLaw:
    """Which craters of a scene have rays, and how bright the rays are."""

    n_rayed: int
    """Largest number of craters with rays. The largest fresh craters get them."""
    strength: float
    """Factor on the brightening: `light.albedo_variation`."""


class _Rays(NamedTuple):
    """The N rays of one crater."""

    x: float
    """x of the crater's centre, O_L, metres."""
    y: float
    """y of the crater's centre, O_L, metres."""
    radius: float
    """Radius of the crater, metres."""
    direction: Array
    """Directions of the rays, counter-clockwise from x, rad (N,)."""
    width: Array
    """Angular standard deviation of the brightness across each ray, rad (N,)."""
    length: Array
    """Lengths (N,) of the rays from the crater's centre, in crater radii."""
    fresh: float
    """Relative brightening of the rays at the crater's rim."""


def add_patches(albedo: Array, grid: Grid, strength: float, seed: int) -> None:
    """Add smooth patches to albedo (n_vertices,), in place; `strength` scales their amplitudes."""
    for length, amplitude in _PATCHES:
        if length >= 3 * grid.spacings_m.min():
            add_waves(albedo, grid, length, amplitude * strength, stream(seed, "albedo", length))


def brightness(craters: Craters) -> Array:
    """Relative brightening (N,) of N craters and their ejecta, which decreases with wear K/R^2.

    It is 0 for craters of a catalogue.
    """
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    return 0.5 * np.exp(-wear / 0.004) * (craters.origin != 2)


def add_rays(
    albedo: Array, grid: Grid, craters: Craters, law: RayLaw, seed: int, removed: np.ndarray | None = None
) -> None:
    """Brighten albedo (n_vertices,) along the rays of craters, in place.

    `removed` craters (indices) get no rays. Their random numbers are drawn nevertheless, so that all other rays stay
    unchanged.
    """
    rng = stream(seed, "rays")
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    local = grid.spacing_at(np.maximum(np.abs(craters.x_m), np.abs(craters.y_m)))
    able = np.flatnonzero((wear < RAYED_WEAR) & (craters.diameter_m > 12 * local) & (craters.origin == 0))
    # Only the largest craters get rays: the rays of a small crater would be only a few pixels long.
    for k in able[np.argsort(-craters.diameter_m[able], kind="stable")][: law.n_rayed]:
        n_rays = int(rng.integers(7, 15))
        direction = rng.uniform(0, 2 * np.pi, n_rays)
        width = rng.uniform(0.05, 0.16, n_rays)
        length = rng.uniform(3.0, RAYS_REACH, n_rays)
        if removed is not None and k in removed:
            continue
        fresh = law.strength * 0.35 * (1 - wear[k] / RAYED_WEAR)
        radius = craters.diameter_m[k] / 2
        rays = _Rays(craters.x_m[k], craters.y_m[k], radius, direction, width, length, fresh)
        _add_rays(albedo, grid.n_half, grid.half_widths_m, rays)


@njit()
def _add_rays(albedo, n_half, half_widths, rays):
    x, y, radius, direction, width, length, fresh = rays
    lines = np.empty((2 * n_half + 1 + 4 * len(half_widths), 7))
    reach = length.max() * radius
    count = lines_in((x - reach, x + reach, y - reach, y + reach), n_half, half_widths, lines)
    for line in range(count):
        first, number = int(lines[line, 4]), int(lines[line, 5])
        for p in range(number):
            px = lines[line, 0] + p * lines[line, 2] - x
            py = lines[line, 1] + p * lines[line, 3] - y
            r = np.sqrt(px * px + py * py) / radius
            if r < 1 or r > reach / radius:
                continue
            angle = np.arctan2(py, px)
            light = 0.0
            for j in range(len(direction)):
                if r < length[j]:
                    turn = (angle - direction[j] + np.pi) % (2 * np.pi) - np.pi
                    light += np.exp(-0.5 * (turn / width[j]) ** 2) * (1 - r / length[j])
            albedo[first + p] += fresh * min(light, 1.0)
