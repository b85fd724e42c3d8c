"""Batches of craters that are removed from the ground of a scene together, so far apart that their effects separate."""

import numpy as np

from perilune_render.terrain.albedo import RAYED_WEAR, RAYS_REACH
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.removal import REACH_RADII
from perilune_shared.geometry.frames import Array

SIGNAL_RADII = 3.0
"""Distance from a crater's centre up to which the change of the image counts as its signal, in radii."""


def removal_reach_m(craters: Craters) -> Array:
    """Distance (N,) within which the removal of each crater changes the ground, metres.

    Only the largest fresh craters of a scene have rays; every crater that may have rays gets the reach of rays.
    """
    radius_m = craters.diameter_m / 2
    may_have_rays = (craters.wear_m2 / radius_m**2 < RAYED_WEAR) & (craters.origin == 0)
    return np.where(may_have_rays, RAYS_REACH, REACH_RADII) * radius_m


def removal_batches(craters: Craters) -> list[np.ndarray]:
    """Indices of `craters` in batches: each crater in one batch, largest craters first.

    In a batch, the ground that the removal of one crater changes does not touch the window of another crater, the disc
    of SIGNAL_RADII around it.
    """
    x, y, radius, reach = craters.x_m, craters.y_m, craters.diameter_m / 2, removal_reach_m(craters)
    batches: list[list[int]] = []
    for k in np.argsort(-radius, kind="stable").tolist():
        for batch in batches:
            distance = np.hypot(x[batch] - x[k], y[batch] - y[k])
            apart = np.maximum(reach[batch] + SIGNAL_RADII * radius[k], SIGNAL_RADII * radius[batch] + reach[k])
            if (distance >= apart).all():
                batch.append(k)
                break
        else:
            batches.append([k])
    return [np.sort(batch) for batch in batches]
