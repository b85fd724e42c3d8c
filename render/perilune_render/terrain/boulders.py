"""The boulder population and its set of rocks.

Shapes: convex hulls of points on ellipsoids with the mean axis ratios of Tsuchiyama et al. 2022 (S/I 0.770, I/L 0.758,
taken second hand), some cut by planes, as fractured rocks are.
"""

from dataclasses import dataclass

import numpy as np
import trimesh

from perilune_render.config import BouldersConfig
from perilune_render.streams import stream
from perilune_render.terrain.craters import Craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.size_frequency import BoulderLaw, draw_diameters, log_bins
from perilune_shared.frames import Array

_BURIED_SHARE = 0.3
"""Share of a boulder's height that lies below the ground."""


@dataclass(frozen=True, slots=True)
class Boulders:
    """N boulders lying on the ground."""

    x_m: Array
    """Centre, O_L, metres (N,)."""
    y_m: Array
    """Centre, O_L, metres (N,)."""
    diameter_m: Array
    """Mean of the three axes, metres (N,)."""
    shape_id: np.ndarray
    """Which rock (N,)."""
    rotation_wxyz: Array
    """rotation_site_from_rock, unit quaternions (N, 4)."""

    def __len__(self) -> int:
        return len(self.x_m)

    def centre_height_m(self, ground_m: Array) -> Array:
        """Height of the centres over O_L's plane, for the ground's height (N,) under each."""
        return ground_m + (0.5 - _BURIED_SHARE) * self.diameter_m


def draw_boulders(config: BouldersConfig, grid: Grid, craters: Craters, seed: int) -> Boulders:
    """The population of a scene: part spread evenly, part around young craters.

    Around a crater the density falls as exp(-x / 0.7), x = r/R, and with age as (1 - age / 4 Gyr)^3, taken
    second hand.
    """
    rng = stream(seed, "boulders")
    smallest = config.min_diameter_spacings * float(np.diff(grid.coordinates_m).min())
    if config.density == 0 or smallest >= config.max_diameter_m:
        none = np.empty(0)
        return Boulders(none, none, none, np.empty(0, np.int64), np.empty((0, 4)))
    edges = log_bins(smallest, config.max_diameter_m, 20)
    half = np.array([grid.half_width_for(low / config.min_diameter_spacings) for low in edges[:-1]])
    diameter = draw_diameters(BoulderLaw(config.density), edges, np.square(2 * half), rng)
    bins = np.clip(np.searchsorted(edges, diameter, side="right") - 1, 0, len(half) - 1)
    reach = half[bins]
    x, y = rng.uniform(-1, 1, (2, len(diameter))) * reach
    weight = craters.diameter_m**2 * np.clip(1 - craters.age_myr / 4000, 0, 1) ** 3 * (craters.diameter_m > 10)
    weight = weight * np.exp(-craters.wear_m2 / (0.05 * (craters.diameter_m / 2) ** 2))
    if len(craters) and weight.sum() > 0:
        host = rng.choice(len(craters), len(diameter), p=weight / weight.sum())
        distance = craters.diameter_m[host] / 2 * (1 + rng.exponential(0.7, len(diameter)))
        angle = rng.uniform(0, 2 * np.pi, len(diameter))
        near_x = craters.x_m[host] + distance * np.cos(angle)
        near_y = craters.y_m[host] + distance * np.sin(angle)
        moved = (rng.random(len(diameter)) < config.clustered_share) & (diameter < craters.diameter_m[host] / 6)
        moved &= (np.abs(near_x) < reach) & (np.abs(near_y) < reach)
        x, y = np.where(moved, near_x, x), np.where(moved, near_y, y)
    shape = rng.integers(0, config.n_shapes, len(diameter))
    turn = rng.normal(size=(len(diameter), 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Boulders(x, y, diameter, shape, np.where(turn[:, :1] < 0, -turn, turn))


def rock(shape_id: int, seed: int) -> trimesh.Trimesh:
    """A rock of mean diameter 1 centred on the origin: convex, every third one with fracture faces."""
    rng = stream(seed, "rock", shape_id)
    points = rng.normal(size=(60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    intermediate = np.clip(rng.normal(0.758, 0.08), 0.5, 1.0)
    short = intermediate * np.clip(rng.normal(0.770, 0.08), 0.5, 1.0)
    points *= np.array([1.0, intermediate, short]) * rng.uniform(0.88, 1.0, (60, 1))
    mesh = trimesh.convex.convex_hull(points)
    if shape_id % 3 == 2:
        for _ in range(2):
            normal = rng.normal(size=3)
            normal /= np.linalg.norm(normal)
            support = float((mesh.vertices @ normal).max())
            kept = mesh.vertices[mesh.vertices @ normal < 0.6 * support]
            cut = trimesh.intersections.mesh_plane(mesh, -normal, normal * 0.6 * support).reshape(-1, 3)
            mesh = trimesh.convex.convex_hull(np.concatenate([kept, cut]))
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(1.0 / float(mesh.extents.mean()))
    return mesh
