"""First hits of single rays, for heights of the ground, ranges of a lidar and shadows on maps."""

import numpy as np

from perilune_render.engines.heightfield.cast import first_hit
from perilune_render.engines.heightfield.cell import NO_FACET, Ray
from perilune_render.engines.heightfield.shade import ground_at, rock_normal
from perilune_render.engines.heightfield.surface import Surface
from perilune_render.provenance.kernels import njit
from perilune_shared.geometry.frames import Array


def first_hits(surface: Surface, origins_m: Array, directions: Array, *, boulders: bool = True) -> tuple[Array, Array]:
    """First hits of rays from points (N, 3), O_L, metres, along directions (N, 3).

    Returns the distances (N,) as multiples of the directions' lengths, infinite without a hit, and the unit normals of
    the facets (N, 3), 0 without a hit. Rays must start above the surface, since they also hit its underside. Without
    `boulders`, rays hit only the ground.
    """
    return first_returns(surface, origins_m, directions, boulders=boulders)[:2]


def first_returns(
    surface: Surface, origins_m: Array, directions: Array, *, boulders: bool = True
) -> tuple[Array, Array, Array]:
    """Distances and normals of `first_hits`, and albedo factors (N,): 1 on boulders, 0 without a hit."""
    origins = np.ascontiguousarray(origins_m - np.array([*surface.centre_m, 0.0]), np.float64)
    rocks = surface.rocks if boulders else surface.rocks._replace(cell_start=np.zeros_like(surface.rocks.cell_start))
    return _hits(surface.ground, rocks, origins, np.ascontiguousarray(directions, np.float64))


def heights_m(surface: Surface, x_m: Array, y_m: Array, *, boulders: bool = True) -> Array:
    """Heights (N,) of the surface at points (N,) of O_L, metres; NaN off the ground."""
    above = surface.ground.highest_m + 1.0
    start = np.stack([x_m, y_m, np.full(len(x_m), above)], axis=1)
    distance, _ = first_hits(surface, start, np.tile([0.0, 0.0, -1.0], (len(x_m), 1)), boulders=boulders)
    return np.where(np.isfinite(distance), above - distance, np.nan)


@njit()
def _hits(ground, rocks, origins, directions):
    """See `first_returns`; points are relative to the grid's centre."""
    distance, normal, albedo = np.empty(len(origins)), np.zeros((len(origins), 3)), np.zeros(len(origins))
    for k in range(len(origins)):
        x, y, z = origins[k]
        dx, dy, dz = directions[k]
        t, facet = first_hit(ground, rocks, None, Ray(x, y, z, dx, dy, dz, NO_FACET), (0.0, np.inf))
        distance[k] = t
        if facet.rock >= 0:
            normal[k, 0], normal[k, 1], normal[k, 2] = rock_normal(rocks, facet.rock, facet.face)
            albedo[k] = 1.0
        elif t < np.inf:
            shading = ground_at(ground, facet, x + t * dx, y + t * dy)
            normal[k, 0], normal[k, 1], normal[k, 2] = shading[4], shading[5], shading[6]
            albedo[k] = shading[3]
    return distance, normal, albedo
