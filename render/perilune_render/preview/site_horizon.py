"""The horizon seen from the landing site towards the Sun. It shows whether the site lies in shadow."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perilune_render.flight.plan import ScenePlan
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array, sun_direction

_MAX_LINES = 5


@dataclass(frozen=True, slots=True)
class SiteHorizon:
    """The point of the ground with the largest elevation angle seen from the site in one direction."""

    elevation_deg: float
    """Elevation above the site's plane, degrees."""
    distance_m: float
    """Horizontal distance from the site, metres."""
    height_m: float
    """Height above the site, metres."""


def site_horizon_of(scene: Scene, azimuth_deg: float) -> SiteHorizon:
    """The horizon seen from the ground at the site, at an azimuth clockwise from north.

    Only the ground of the scene counts, without boulders: ground beyond its edge casts no shadow in frames either.
    """
    towards = sun_direction(azimuth_deg, 0.0)[:2]
    distance = _distances(scene.grid, towards)
    heights = scene.height_m.astype(np.float64)
    at_site = float(value_at(heights, scene.grid, 0.0, 0.0))
    height = value_at(heights, scene.grid, *(distance[:, None] * towards).T) - at_site
    elevation = np.degrees(np.arctan2(height, distance))
    highest = int(np.argmax(elevation))
    return SiteHorizon(float(elevation[highest]), float(distance[highest]), float(height[highest]))


def _distances(grid: Grid, towards: Array) -> Array:
    """Distances (N,) from the site to the edge of the ground, metres, half a vertex spacing apart."""
    slant = np.abs(towards).max()
    inner = np.linspace(0, grid.half_widths_m[0], 2 * grid.n_half + 1)[1:]
    rings = np.interp(
        np.arange(1, 2 * len(grid.half_widths_m) - 1) / 2, np.arange(len(grid.half_widths_m)), grid.half_widths_m
    )
    return np.concatenate([inner, rings]) / slant


def shadow_warnings(scene: Scene, plans: Sequence[ScenePlan]) -> list[str]:
    """A warning for each plan over this ground whose Sun is below the site's horizon.

    After _MAX_LINES warnings, one more line counts the others.
    """
    lines = []
    for plan in plans:
        horizon = site_horizon_of(scene, plan.sun_azimuth_deg)
        if horizon.elevation_deg > plan.sun_elevation_deg:
            lines.append(
                f"warning: {plan.scene_id}: the site lies in shadow: the Sun at azimuth {plan.sun_azimuth_deg:.1f} is "
                f"{plan.sun_elevation_deg:.1f} degrees high, and ground {horizon.distance_m:.0f} m away reaches "
                f"{horizon.elevation_deg:.1f} degrees"
            )
    more = len(lines) - _MAX_LINES
    return lines if more <= 0 else [*lines[:_MAX_LINES], f"warning: the site lies in shadow under {more} more Suns"]
