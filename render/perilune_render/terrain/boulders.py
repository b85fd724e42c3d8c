"""The boulder population and the rock shapes.

Shapes are convex hulls of points on ellipsoids with the mean axis ratios of Tsuchiyama et al. 2022 (short to
intermediate axis 0.770, intermediate to long axis 0.758). Some are cut by planes, like fractured rocks.

Deviation from observations: near fresh craters, the observed number of boulders larger than D falls as D^-4 above
4.4 m. Here it falls as D^-2.482 everywhere (`BoulderLaw`), and no boulder in the field around a crater is larger than a
twentieth of the crater's diameter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from perilune_render.config.terrain import BouldersConfig
from perilune_render.streams import stream
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.size_frequency import BoulderLaw, draw_diameters, expected_numbers, log_bins
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, matrix_from_quaternion

if TYPE_CHECKING:
    import trimesh

MAX_BOULDERS = 3_000_000
"""Largest expected number of boulders in a scene. The limit applies separately to boulders spread over the whole ground
and to boulders in the fields around craters. A boulder needs about 1 kB in a renderer."""
_BURIED_SHARE = 0.3
"""Share of a boulder's height that is below the ground."""
_FIELD_DECAY = 0.7
"""Decay length of a boulder field's density beyond the crater's rim, in crater radii."""
FULL_SPACINGS = 5.0
"""Smallest diameter of a boulder with the finer of two meshes, in vertex spacings of the ground below the boulder."""
_FARTHEST = 0.9
"""Largest distance of a rock's surface from its centre, in mean diameters. The flattest, longest rock reaches it."""
N_POINTS, N_FEW_POINTS = 60, 14
"""Numbers of points from which the finer and the coarser mesh of a rock are made."""


@dataclass(frozen=True, slots=True)
class Boulders:
    """N boulders on the ground."""

    x_m: Array
    """x of the centres, O_L, metres (N,)."""
    y_m: Array
    """y of the centres, O_L, metres (N,)."""
    diameter_m: Array
    """Mean of the three axes, metres (N,)."""
    shape_id: np.ndarray
    """Index of the rock shape (N,)."""
    rotation_wxyz: Array
    """rotation_site_from_rock, unit quaternions (N, 4)."""

    def __len__(self) -> int:
        return len(self.x_m)

    def chosen(self, selection: np.ndarray) -> Boulders:
        """The boulders selected by indices or by a mask."""
        return Boulders(*(getattr(self, field.name)[selection] for field in dataclasses.fields(self)))

    def centre_height_m(self, ground_m: Array) -> Array:
        """Heights (N,) of the centres above O_L's plane, metres, given the ground's heights (N,) there."""
        return ground_m + (0.5 - _BURIED_SHARE) * self.diameter_m


def draw_boulders(
    config: BouldersConfig, grid: Grid, craters: Craters, seed: int, removed: Sequence[int] | np.ndarray = ()
) -> Boulders:
    """Draw the boulders of a scene: a uniform density on the whole ground, and fields around young craters.

    Fields surround primary craters with a diameter of at least 10 m. At the rim of a newly formed crater the density of
    its field is `field_density` times the uniform density. Three factors lower the density of a field:

    - exp(-(x - 1) / 0.7), where x is the distance from the crater's centre in crater radii R;
    - (1 - age / 4 Gyr)^3;
    - exp(-K / (0.05 R^2)), where K is the crater's wear (`Craters.wear_m2`). This factor is our choice.

    The fields of `removed` craters (indices) are drawn and then omitted, so that all other fields stay unchanged.
    """
    rng = stream(seed, "boulders")
    smallest = config.min_diameter_spacings * float(grid.spacings_m.min())
    if config.density == 0 or smallest >= config.max_diameter_m:
        empty = np.empty(0)
        return Boulders(empty, empty, empty, np.empty(0, np.int64), np.empty((0, 4)))
    law, edges, half = _bins(config, grid)
    plain = draw_diameters(law, edges, np.square(2 * half), rng)
    reach = half[np.clip(np.searchsorted(edges, plain, side="right") - 1, 0, len(half) - 1)]
    x, y = rng.uniform(-1, 1, (2, len(plain))) * reach
    field_x, field_y, field, host = _fields(config, law, grid, craters, rng)
    x, y, diameter = np.concatenate([x, field_x]), np.concatenate([y, field_y]), np.concatenate([plain, field])
    shape = rng.integers(0, config.n_shapes, len(diameter))
    rotation = rng.normal(size=(len(diameter), 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    drawn = Boulders(x, y, diameter, shape, np.where(rotation[:, :1] < 0, -rotation, rotation))
    on_plain = np.ones(len(plain), bool)
    return drawn.chosen(np.concatenate([on_plain, ~np.isin(host, removed)])) if len(removed) else drawn


def _bins(config: BouldersConfig, grid: Grid) -> tuple[BoulderLaw, Array, Array]:
    """The size law, the edges of the size bins (B + 1,), and a half-width for each bin (B,), metres.

    Boulders of a bin are drawn in a square with this half-width around the site. Farther out, the vertex spacing is too
    large for boulders of the bin's smallest diameter (`min_diameter_spacings`).
    """
    smallest = config.min_diameter_spacings * float(grid.spacings_m.min())
    edges = log_bins(smallest, config.max_diameter_m, 20)
    half = np.array([grid.half_width_for(low / config.min_diameter_spacings) for low in edges[:-1]])
    return BoulderLaw(density=config.density), edges, half


def check_boulders(config: BouldersConfig, grid: Grid) -> None:
    """Raise UserError, before drawing, if the uniformly spread boulders would not fit in memory."""
    if config.density > 0 and config.min_diameter_spacings * float(grid.spacings_m.min()) < config.max_diameter_m:
        law, edges, half = _bins(config, grid)
        _check_number(float(expected_numbers(law, edges, np.square(2 * half)).sum()), "density")


def _check_number(number: float, setting: str) -> None:
    if number > MAX_BOULDERS:
        expected = f"at most {MAX_BOULDERS}: lower {setting}, or raise min_diameter_spacings"
        raise UserError("dataset.terrain.boulders", "number", f"about {number:.3g} in a scene", expected)


def _fields(
    config: BouldersConfig, law: BoulderLaw, grid: Grid, craters: Craters, rng: np.random.Generator
) -> tuple[Array, Array, Array, np.ndarray]:
    """x, y and diameters of the boulders around young craters, and the index of each boulder's crater."""
    radius = craters.diameter_m / 2
    age = np.nan_to_num(craters.age_myr, nan=4000.0)
    young = np.clip(1 - age / 4000, 0, 1) ** 3 * np.exp(-craters.wear_m2 / (0.05 * radius**2))
    young = np.where((craters.diameter_m >= 10) & (craters.origin == 0), young, 0.0)
    local = config.min_diameter_spacings * grid.spacing_under(craters.x_m, craters.y_m)
    # The boulders of a field have at most a twentieth of the crater's diameter.
    largest = np.minimum(config.max_diameter_m, craters.diameter_m / 20)
    per_area = np.where(largest > local, law.csfd(local) - law.csfd(np.maximum(largest, local)), 0.0)
    # With a = _FIELD_DECAY, the integral of exp(-(x - 1) / a) over the plane outside the rim is 2 pi R^2 (a + a^2).
    area = 2 * np.pi * radius**2 * (_FIELD_DECAY + _FIELD_DECAY**2)
    expected = config.field_density * young * per_area * area
    _check_number(float(expected.sum()), "field_density")
    number = rng.poisson(expected)
    host = np.repeat(np.arange(len(craters)), number)
    n_small, n_large = law.csfd(local[host]), law.csfd(largest[host])
    share = rng.random(len(host))
    diameter = ((n_small - share * (n_small - n_large)) / law.csfd(1.0)) ** (1 / -2.482)
    # With a density of exp(-(x - 1) / a) per area, x - 1 is a mixture of Gamma distributions of orders 1 and 2.
    order = np.where(rng.random(len(host)) < 1 / (1 + _FIELD_DECAY), 1, 2)
    distance = radius[host] * (1 + _FIELD_DECAY * rng.gamma(order))
    angle = rng.uniform(0, 2 * np.pi, len(host))
    x, y = craters.x_m[host] + distance * np.cos(angle), craters.y_m[host] + distance * np.sin(angle)
    on_grid = np.maximum(np.abs(x), np.abs(y)) < grid.extent_m / 2
    inside = (diameter >= config.min_diameter_spacings * grid.spacing_under(x, y)) & on_grid
    return x[inside], y[inside], diameter[inside], host[inside]


def rock(shape_id: int, seed: int, n_points: int = N_POINTS) -> trimesh.Trimesh:
    """A convex rock of mean diameter 1, centred on the origin; every third shape has fracture faces.

    With fewer points the rock has a similar shape and fewer faces, for boulders only a few pixels wide.
    """
    import trimesh  # imported here, since it takes half a second

    rng = stream(seed, "rock", shape_id)
    points = rng.normal(size=(60, 3))[:n_points]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    intermediate = np.clip(rng.normal(0.758, 0.08), 0.5, 1.0)
    short = intermediate * np.clip(rng.normal(0.770, 0.08), 0.5, 1.0)
    points *= np.array([1.0, intermediate, short]) * rng.uniform(0.88, 1.0, (len(points), 1))
    mesh = trimesh.convex.convex_hull(points)
    if shape_id % 3 == 2:
        for _ in range(2):
            normal = rng.normal(size=3)
            normal /= np.linalg.norm(normal)
            support = float((mesh.vertices @ normal).max())
            below = mesh.vertices[mesh.vertices @ normal < 0.6 * support]
            cut = trimesh.intersections.mesh_plane(mesh, -normal, normal * 0.6 * support).reshape(-1, 3)
            mesh = trimesh.convex.convex_hull(np.concatenate([below, cut]))
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(1.0 / float(mesh.extents.mean()))
    return mesh


def highest_points(boulders: Boulders, z_m: Array, grid: Grid, seed: int) -> Array:
    """The highest vertex of each boulder (N, 3), O_L, metres; for the arguments see `boulder_mesh`."""
    full = boulders.diameter_m >= FULL_SPACINGS * grid.spacing_under(boulders.x_m, boulders.y_m)
    kinds = list(zip(boulders.shape_id.tolist(), np.where(full, N_POINTS, N_FEW_POINTS).tolist(), strict=True))
    solids = {kind: rock(kind[0], seed, kind[1]).vertices for kind in set(kinds)}
    points = np.stack([boulders.x_m, boulders.y_m, z_m], axis=-1)
    for k, rotation in enumerate(matrix_from_quaternion(boulders.rotation_wxyz.reshape(-1, 4))):
        placed = solids[kinds[k]] @ rotation.T * boulders.diameter_m[k]
        points[k] += placed[np.argmax(placed[:, 2])]
    return points


def largest_height_m(boulders: Boulders) -> float:
    """Upper bound on the height of the boulders' tops above the ground, metres."""
    return float(_FARTHEST + 0.5) * float(boulders.diameter_m.max(initial=0.0))


def tops_m(boulders: Boulders, z_m: Array, grid: Grid, seed: int, x_m: Array, y_m: Array) -> Array:
    """Height of the highest boulder surface at each position (M,), O_L, metres; -inf without a boulder.

    For the first four arguments see `boulder_mesh`.
    """
    tops = np.full(len(x_m), -np.inf)
    widest = _FARTHEST * boulders.diameter_m.max(initial=0.0)
    if not len(x_m) or not len(boulders):
        return tops
    near = (boulders.x_m > x_m.min() - widest) & (boulders.x_m < x_m.max() + widest)
    near = np.flatnonzero(near & (boulders.y_m > y_m.min() - widest) & (boulders.y_m < y_m.max() + widest))
    rocks, points = boulders.chosen(near), np.stack([x_m, y_m], axis=-1)
    full = rocks.diameter_m >= FULL_SPACINGS * grid.spacing_under(rocks.x_m, rocks.y_m)
    rotations = matrix_from_quaternion(rocks.rotation_wxyz.reshape(-1, 4))
    around = cKDTree(np.stack([rocks.x_m, rocks.y_m], axis=-1)).query_ball_point(points, widest)
    solids: dict[tuple[int, int], trimesh.Trimesh] = {}
    for index, candidates in enumerate(around):
        for k in candidates:
            away = points[index] - [rocks.x_m[k], rocks.y_m[k]]
            if np.hypot(*away) > _FARTHEST * rocks.diameter_m[k]:
                continue
            kind = int(rocks.shape_id[k]), N_POINTS if full[k] else N_FEW_POINTS
            if kind not in solids:
                solids[kind] = rock(kind[0], seed, kind[1])
            top = _top(solids[kind], away @ rotations[k, :2] / rocks.diameter_m[k], rotations[k, 2])
            tops[index] = max(tops[index], z_m[near[k]] + rocks.diameter_m[k] * top)
    return tops


def _top(solid: trimesh.Trimesh, origin: Array, direction: Array) -> float:
    """Distance from `origin` to where a line leaves a convex solid; -inf if it misses the solid."""
    normal, corner = solid.face_normals, solid.triangles[:, 0]
    gap, slope = np.einsum("fi,fi->f", normal, corner - origin), normal @ direction
    out, into = slope > 1e-9, slope < -1e-9
    leaves, enters = (gap[out] / slope[out]).min(), (gap[into] / slope[into]).max()
    return float(leaves) if leaves > enters else -np.inf


def boulder_mesh(boulders: Boulders, z_m: Array, grid: Grid, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """All boulders as one mesh: vertices (V, 3) float32 in O_L, metres, and triangles (F, 3) int32.

    `z_m` (N,) holds the heights of the centres. Every boulder is a copy of one of the rocks drawn from `seed`. Boulders
    smaller than FULL_SPACINGS local vertex spacings use the mesh with fewer faces. All boulders form one mesh, since
    each object in Cycles adds render time to every frame.
    """
    local = grid.spacing_under(boulders.x_m, boulders.y_m)
    full = boulders.diameter_m >= FULL_SPACINGS * local
    rotations = matrix_from_quaternion(boulders.rotation_wxyz.reshape(-1, 4))
    centres = np.stack([boulders.x_m, boulders.y_m, z_m], axis=-1)
    vertices, faces, n_before = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.int32)], 0
    for shape_id in np.unique(boulders.shape_id):
        for n_points, which in ((N_POINTS, full), (N_FEW_POINTS, ~full)):
            chosen = np.flatnonzero((boulders.shape_id == shape_id) & which)
            if not len(chosen):
                continue
            solid = rock(int(shape_id), seed, n_points)
            scaled = solid.vertices[None] * boulders.diameter_m[chosen, None, None]
            placed = np.einsum("nij,nkj->nki", rotations[chosen], scaled) + centres[chosen, None]
            shift = n_before + len(solid.vertices) * np.arange(len(chosen))
            vertices.append(placed.reshape(-1, 3).astype(np.float32))
            faces.append((solid.faces[None] + shift[:, None, None]).reshape(-1, 3).astype(np.int32))
            n_before += placed.shape[0] * placed.shape[1]
    return np.concatenate(vertices), np.concatenate(faces)
