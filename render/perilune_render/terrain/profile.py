"""Crater profiles, fresh and worn, as tables over distance and wear.

Fresh shape: Fassett & Thomson 2014, eq. 4 (doi 10.1002/2014JE004698). Deviations: the outer polynomial is scaled by
13 % so that it meets the rim at x = 1.02 (as printed it leaves a step of 0.004 D, which renders as a ring); the bowl
is scaled to the wanted depth and its floor rounded by a soft minimum, where the source cuts it flat; every profile is
at least slightly worn (K/R^2 = 0.001), so that no crest is sharper than a few hundredths of the radius.

Wear: topographic diffusion dh/dt = kappa laplacian h (same source), solved exactly on a radial grid. With x = r/R it
depends on K/R^2 alone, K = kappa t. A fresh profile is linear in the depth-to-diameter ratio d/D,
h/D = rim(x) + d/D bowl(x), and diffusion is linear too, so that two tables serve all craters. A third holds how much of
the older ground the crater has removed, diffused likewise: its edge widens with wear and leaves no ridge.
"""

import functools
from dataclasses import dataclass

import numpy as np

from perilune_shared.frames import Array

REACH = 3.0
"""Profiles are cut at this distance over the radius."""
_DOMAIN, _N_RADIAL = 6.0, 600
_RIM = 0.036822
LEAST_WEAR, MOST_WEAR, N_WEAR = 1e-3, 0.6, 48


@dataclass(frozen=True, slots=True)
class ProfileTables:
    """Tables over wear (rows, even in log K/R^2) and distance (columns, even in x from 0 to REACH)."""

    rim: Array
    """Height over D of rim and ejecta (N_WEAR, n_x)."""
    bowl: Array
    """Height over D for d/D = 1 (N_WEAR, n_x)."""
    removed: Array
    """Share of the older ground that is gone (N_WEAR, n_x)."""


def fresh_rim(x: Array) -> Array:
    """Height over D of rim and ejecta blanket at x = r/R; inside the rim the level of its crest."""
    outer = 0.188253307 - 0.187050452 * x + 0.01844746 * x**2 + 0.01505647 * x**3
    at_crest = 0.188253307 - 0.187050452 * 1.02 + 0.01844746 * 1.02**2 + 0.01505647 * 1.02**3
    return np.select([x <= 1.02, x < 1.5], [np.full_like(x, _RIM), outer * _RIM / at_crest])


def fresh_bowl(x: Array) -> Array:
    """Depth below the crest at x = r/R for a depth of 1: -1 at the centre, 0 from the rim on."""
    inner = np.minimum(x, 0.98)
    poly = -0.228809953 + 0.227533882 * inner + 0.083116795 * inner**2 - 0.039499407 * inner**3
    sunk = 1.25 * np.maximum(_RIM - poly, 0) / (_RIM + 0.228809953)
    soft = 0.08
    floor = -soft * np.log(np.exp(-sunk / soft) + np.exp(-1 / soft))
    level = -soft * np.log(1 + np.exp(-1 / soft))
    deepest = -soft * np.log(np.exp(-1.25 / soft) + np.exp(-1 / soft))
    return -(floor - level) / (deepest - level)


def fresh_depth_ratio(diameter_m: Array) -> Array:
    """Fresh depth over diameter: Stopar et al. 2017, taken second hand.

    Their steps (0.21 from 400 m, 0.17, 0.15, 0.13 from 40 m; extrapolated to 0.11 and 0.10 below) are joined by lines
    in log D through the middles of their ranges.
    """
    return np.interp(np.log10(diameter_m), np.log10([5, 20, 63, 141, 283, 500]), [0.10, 0.11, 0.13, 0.15, 0.17, 0.21])


@functools.cache
def profile_tables() -> ProfileTables:
    """The tables, computed once."""
    step = _DOMAIN / _N_RADIAL
    x = (np.arange(_N_RADIAL) + 0.5) * step
    edges = np.arange(1, _N_RADIAL) * step
    # Finite volumes: the operator becomes symmetric once scaled by the square root of each ring's area.
    flow = edges / step
    diagonal = np.zeros(_N_RADIAL)
    diagonal[:-1] -= flow
    diagonal[1:] -= flow
    area = x * step
    root = np.sqrt(area)
    operator = (
        np.diag(diagonal / area)
        + np.diag(flow / (root[:-1] * root[1:]), 1)
        + np.diag(flow / (root[:-1] * root[1:]), -1)
    )
    rates, modes = np.linalg.eigh(operator)
    wear = np.geomspace(LEAST_WEAR, MOST_WEAR, N_WEAR)
    decay = np.exp(rates[None, :] * wear[:, None])
    columns = np.linspace(0, REACH, 301)
    taper = np.clip((REACH - columns) / 0.5, 0, 1)
    taper = taper * taper * (3 - 2 * taper)

    def worn(fresh: Array) -> Array:
        amplitudes = modes.T @ (fresh * root)
        rows = (decay * amplitudes) @ modes.T / root
        return np.array([np.interp(columns, x, row) for row in rows], np.float64) * taper

    return ProfileTables(worn(fresh_rim(x)), worn(fresh_bowl(x)), worn((x < 1.08).astype(np.float64)))
