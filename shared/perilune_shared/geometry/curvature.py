"""Curvature of the ground: a sphere with the Moon's radius touches the plane z = 0 at the site (O_L)."""

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import MOON_RADIUS_M, Array


def drop_m(x_m: ArrayLike, y_m: ArrayLike) -> Array:
    """Return the depth (...) of the sphere below z = 0 in O_L, metres: R - sqrt(R^2 - x^2 - y^2)."""
    square = np.square(np.asarray(x_m, np.float64)) + np.square(np.asarray(y_m, np.float64))
    # This form keeps full precision for a small drop.
    return square / (MOON_RADIUS_M + np.sqrt(np.square(MOON_RADIUS_M) - square))


def horizon_m(height_m: ArrayLike) -> Array:
    """Return the distance sqrt(2Rh + h^2) (...), metres, to the horizon from a height above the sphere."""
    height = np.asarray(height_m, np.float64)
    return np.sqrt(2 * MOON_RADIUS_M * height + np.square(height))


def hits_sphere(position_m: Array, rays: Array) -> np.ndarray:
    """Whether S rays (N, S, 3) from each position (N, 3), in O_L, hit the sphere; true from inside."""
    from_centre = (position_m + np.array([0, 0, MOON_RADIUS_M]))[:, None]
    along = np.einsum("nsi,nsi->ns", np.broadcast_to(from_centre, rays.shape), rays)
    above = np.square(from_centre).sum(axis=-1) - MOON_RADIUS_M**2
    return (above <= 0) | ((along < 0) & (np.square(along) >= np.square(rays).sum(axis=-1) * above))
