r"""What each ray of an image sees: the hit, its shading, and whether the Sun reaches it.

        camera               Sun
            \       ^       /
             \      |      /
    1. view   \     |     /  4. shadow ray, to a random point of the Sun's disc
       ray     \    |    /
                \   |   +    3. its start, lifted where the ray grazes the facet
                 \  |
        __________\_|__________ facet, with its shading normal (2)

`see` renders a tile of the image, block by block of BLOCK_PX pixels:

- `begin_m` and `only_part` find the height at which all rays of a block may begin, and the part of the mesh below it;
- `_read_ahead` prefetches the memory that the rays will need;
- `sample_seen` casts the ray of one sample (1), shades its hit by `ground_at` or `rock_normal` (2), moves the start of
  a grazing shadow ray by `lift_at` (3), and casts the shadow ray (4), unless the hit is surely lit.
"""

import math
from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.beam import BLOCK_PX, begin_m, only_part
from perilune_render.engines.heightfield.cast import any_ring_at, first_hit, first_hit_anywhere, first_hit_in_part
from perilune_render.engines.heightfield.cell import NO_FACET, Ray
from perilune_render.engines.heightfield.horizon import Horizon, surely_lit
from perilune_render.engines.heightfield.prefetch import prefetch
from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, ring_vertex, vertex_index, vertex_xy
from perilune_render.provenance.kernels import njit
from perilune_shared.geometry.frames import Array

_LIFT = 1e-4
"""Distance from the hit at which a shadow ray begins, metres. A shadow ray cannot hit its own triangle or boulder. From
an edge of the triangle, it could hit the neighbouring triangle because of rounding."""
_TERMINATOR = 0.1
"""Cosine between ground and Sun below which Cycles moves the start of a shadow ray from the facet to the curved surface
that the vertex normals describe: the default of Cycles' setting "shadow terminator geometry offset"."""


class View(NamedTuple):
    """Camera and Sun of an image. Positions are relative to the grid's centre, vectors are in O_L."""

    origin: Array
    """Position of the camera, metres (3,)."""
    basis: Array
    """Basis of the rays (3, 3): the ray at image coordinates (u, v), pixels, is u basis[0] + v basis[1] + basis[2]. Its
    component along the camera's axis is 1."""
    far_m: float
    """Depth along the camera's axis at which rays end, metres."""
    sun: Array
    """Unit vector to the centre of the Sun's disc (3,)."""
    plane: Array
    """Axes of the Sun's disc (2, 3): the ray to its point (p, q) is along sun + p plane[0] + q plane[1]."""
    horizon: Horizon
    """Where this Sun surely lights the ground."""


class Tile(NamedTuple):
    """A tile of the image: S samples in each of h x w pixels, and the arrays for their results."""

    first: tuple[int, int]
    """Row and column of the tile's first pixel."""
    moved: np.ndarray
    """Offsets of the samples from the centres of their pixels, pixels (S, h, w, 2)."""
    disc: np.ndarray
    """Points (p, q) of the Sun's disc for the samples' shadow rays (S, h, w, 2)."""
    depth: np.ndarray
    """Depth image, metres (H, W); the first sample writes the tile's pixels, inf for a miss."""
    normal: np.ndarray
    """Image of the unit shading normal, O_L (H, W, 3); the first sample writes the tile's pixels, 0 for a miss."""
    angles: np.ndarray
    """Results of each sample (5, S, h, w): mu0, mu, cosine of the phase angle, albedo, and cosine of incidence for the
    sampled point of the disc, 0 in shadow."""


class Block(NamedTuple):
    """Start of all rays of a block of pixels."""

    begin_m: float
    """Height at which the rays may begin, metres (`beam.begin_m`); infinite for their start."""
    part: int
    """Part of the mesh below this height, -1 if unknown (`beam.only_part`)."""


@njit(inline="always", **WITHOUT_COUNTS)
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(inline="always", **WITHOUT_COUNTS)
def _normal(vertices, k):
    """Unit normal of a vertex, pointing upwards."""
    x, y = float(vertices[k, 0]), float(vertices[k, 1])
    return x, y, math.sqrt(max(1 - x * x - y * y, 0.0))


@njit(inline="always", **WITHOUT_COUNTS)
def _corners(ground, facet, x, y):
    """Vertices of a triangle, edges from its first vertex, z of their cross product, two weights.

    The two weights belong to the second and the third vertex at (x, y).
    """
    n, half, vertices = ground.n_half, ground.half_widths_m, ground.vertex
    part, row, column = facet.part, facet.row, facet.column
    a, b = (1, 2) if facet.triangle == 0 else (2, 3)
    v0, v1, v2 = (
        vertex_index(part, row, column, 0, n),
        vertex_index(part, row, column, a, n),
        vertex_index(part, row, column, b, n),
    )
    x0, y0 = vertex_xy(part, row, column, 0, n, half)
    x1, y1 = vertex_xy(part, row, column, a, n, half)
    x2, y2 = vertex_xy(part, row, column, b, n, half)
    e1x, e1y, e1z = x1 - x0, y1 - y0, float(vertices[v1, 2] - vertices[v0, 2])
    e2x, e2y, e2z = x2 - x0, y2 - y0, float(vertices[v2, 2] - vertices[v0, 2])
    area = e1x * e2y - e1y * e2x
    v = ((x - x0) * e2y - (y - y0) * e2x) / area
    w = (e1x * (y - y0) - e1y * (x - x0)) / area
    return v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, area, v, w


@njit(**INLINED)
def ground_at(ground, facet, x, y):
    """Shading of a triangle at (x, y): unit normal, albedo, and the unit normal of the triangle."""
    vertices = ground.vertex
    v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, area, v, w = _corners(ground, facet, x, y)
    u = 1 - v - w
    fx, fy, fz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, area
    size = 1 / math.sqrt(fx * fx + fy * fy + fz * fz)
    ax, ay, az = _normal(vertices, v0)
    bx, by, bz = _normal(vertices, v1)
    cx, cy, cz = _normal(vertices, v2)
    nx, ny, nz = u * ax + v * bx + w * cx, u * ay + v * by + w * cy, u * az + v * bz + w * cz
    albedo = u * abs(vertices[v0, 3]) + v * abs(vertices[v1, 3]) + w * abs(vertices[v2, 3])
    length = 1 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * length, ny * length, nz * length, albedo, fx * size, fy * size, fz * size


@njit(**INLINED)
def lift_at(ground, facet, x, y):
    """The vector by which Cycles lifts the start of a grazing shadow ray from a triangle, metres.

    The ray starts at (x, y). The vector points along the interpolated normal, and its length is the larger of two
    heights. The first is the height of the lowest tangent plane of the vertices, each shifted until the triangle is
    below it. The second is half the height of a quadratic patch with these vertex normals.
    """
    vertices = ground.vertex
    v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, _, v, w = _corners(ground, facet, x, y)
    u = 1 - v - w
    ax, ay, az = _normal(vertices, v0)
    bx, by, bz = _normal(vertices, v1)
    cx, cy, cz = _normal(vertices, v2)
    nx, ny, nz = u * ax + v * bx + w * cx, u * ay + v * by + w * cy, u * az + v * bz + w * cz
    # A patch perpendicular to the vertex normals bulges over an edge by the edge's length times the change of slope.
    edge_1 = (bx - ax) * e1x + (by - ay) * e1y + (bz - az) * e1z
    edge_2 = (cx - ax) * e2x + (cy - ay) * e2y + (cz - az) * e2z
    edge_3 = (cx - bx) * (e2x - e1x) + (cy - by) * (e2y - e1y) + (cz - bz) * (e2z - e1z)
    bulge = u * v * edge_1 + u * w * edge_2 + v * w * edge_3
    # Shift each vertex's tangent plane until no vertex is above it, and take its height above the point.
    px, py, pz = v * e1x + w * e2x, v * e1y + w * e2y, v * e1z + w * e2z
    over_0 = max(max(_dot(e1x, e1y, e1z, ax, ay, az), _dot(e2x, e2y, e2z, ax, ay, az)), 0.0)
    over_1 = max(max(-_dot(e1x, e1y, e1z, bx, by, bz), _dot(e2x - e1x, e2y - e1y, e2z - e1z, bx, by, bz)), 0.0)
    over_2 = max(max(-_dot(e2x, e2y, e2z, cx, cy, cz), _dot(e1x - e2x, e1y - e2y, e1z - e2z, cx, cy, cz)), 0.0)
    over_0 = max(over_0 - _dot(px, py, pz, ax, ay, az), 0.0)
    over_1 = max(over_1 - _dot(px - e1x, py - e1y, pz - e1z, bx, by, bz), 0.0)
    over_2 = max(over_2 - _dot(px - e2x, py - e2y, pz - e2z, cx, cy, cz), 0.0)
    bulge = max(min(min(over_0, over_1), over_2), 0.5 * bulge)
    return bulge * nx, bulge * ny, bulge * nz


@njit(**INLINED)
def rock_normal(rocks, k, face):
    """Unit normal of a face of boulder k, O_L."""
    m, px, py, pz = rocks.rows[k], rocks.planes[face, 0], rocks.planes[face, 1], rocks.planes[face, 2]
    nx, ny, nz = (
        m[3] * px + m[6] * py + m[9] * pz,
        m[4] * px + m[7] * py + m[10] * pz,
        m[5] * px + m[8] * py + m[11] * pz,
    )
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@njit(**INLINED)
def sample_seen(ground, rocks, view, block, place, disc):
    """Cast the ray at image coordinates `place` (u, v), and its shadow ray to the point `disc` (p, q) of the disc.

    Returns three tuples: the height at which the next ray may begin, metres, and the depth of the hit; the unit shading
    normal; and what `Tile.angles` stores. The height is the height of the hit, or `block.begin_m` without a hit.
    """
    horizon, sun, plane = view.horizon, view.sun, view.plane
    dx, dy, dz = _direction(view.basis, place[0], place[1])
    ray = Ray(view.origin[0], view.origin[1], view.origin[2], dx, dy, dz, NO_FACET)
    begin = max((block.begin_m - ray.z) / dz, 0.0) if block.begin_m < np.inf else 0.0
    # 1. The view ray.
    if block.part >= 0:
        t, facet = first_hit_in_part(ground, rocks, block.part, ray, (begin, view.far_m))
    else:
        t, facet = first_hit_anywhere(ground, rocks, ray, (begin, view.far_m))
    # 2. Shading normal n, and normal f of the facet.
    nx, ny, nz, albedo, fx, fy, fz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y, z = ray.x + t * dx, ray.y + t * dy, ray.z + t * dz
    hit_z = z if t < np.inf else block.begin_m
    if facet.rock >= 0:
        nx, ny, nz = rock_normal(rocks, facet.rock, facet.face)
        albedo = 1.0
    elif t < np.inf:
        nx, ny, nz, albedo, fx, fy, fz = ground_at(ground, facet, x, y)
    # Direction l to a point of the Sun's disc; photometry uses the centre of the disc.
    p, q = disc
    lx, ly = sun[0] + p * plane[0, 0] + q * plane[1, 0], sun[1] + p * plane[0, 1] + q * plane[1, 1]
    lz = sun[2] + p * plane[0, 2] + q * plane[1, 2]
    to_disc = 1 / math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx * to_disc, ly * to_disc, lz * to_disc
    per_length = 1 / math.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = nx * lx + ny * ly + nz * lz
    mu0 = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 1e-4)
    mu = max(-(nx * dx + ny * dy + nz * dz) * per_length, 1e-4)
    cos_phase = -(sun[0] * dx + sun[1] * dy + sun[2] * dz) * per_length
    lit = 0.0
    if cosine > 0:
        surely = False
        # 3. A shadow ray that grazes the ground begins above the facet, as in Cycles.
        if facet.rock < 0:
            on_facet = fx * lx + fy * ly + fz * lz
            share = 2 - (on_facet + cosine) / _TERMINATOR if cosine < _TERMINATOR else 1 - on_facet / _TERMINATOR
            share = min(max(share, 0.0), 1.0)
            if share > 0:
                mx, my, mz = lift_at(ground, facet, x, y)
                x, y, z = x + share * mx, y + share * my, z + share * mz
            else:
                surely = surely_lit(horizon, x, y, z)
        # 4. The shadow ray; its parameter is -inf if it reaches ground that is surely lit.
        shadow_ray = Ray(x, y, z, lx, ly, lz, facet)
        if surely or abs(first_hit(ground, rocks, horizon, shadow_ray, (_LIFT, np.inf))[0]) == np.inf:
            lit = cosine
    return (hit_z, t), (nx, ny, nz), (mu0, mu, cos_phase, albedo, lit)


@njit(**INLINED)
def _see(ground, rocks, view, tile, block, sample):
    """Write what one sample, (s, row, column) in the tile, sees into the arrays of the tile.

    Returns the height of the hit, metres; without a hit, the height at which the ray begins.
    """
    s, i, j = sample
    disc = tile.disc[s, i, j, 0], tile.disc[s, i, j, 1]
    (hit_z, t), normal, angles = sample_seen(ground, rocks, view, block, _coordinates(tile, s, i, j), disc)
    if s == 0:
        row, column = tile.first[0] + i, tile.first[1] + j
        tile.depth[row, column] = t
        tile.normal[row, column, 0], tile.normal[row, column, 1], tile.normal[row, column, 2] = normal
    for k in range(5):
        tile.angles[k, s, i, j] = angles[k]
    return hit_z


@njit(inline="always", **WITHOUT_COUNTS)
def _coordinates(tile, s, i, j):
    """Image coordinates u and v of sample s in pixel (i, j) of a tile."""
    u, v = tile.first[1] + j + 0.5 + tile.moved[s, i, j, 0], tile.first[0] + i + 0.5 + tile.moved[s, i, j, 1]
    return u, v


@njit(inline="always", **WITHOUT_COUNTS)
def _direction(basis, u, v):
    """Direction of the ray at image coordinates (u, v); see `View.basis`."""
    dx = u * basis[0, 0] + v * basis[1, 0] + basis[2, 0]
    dy = u * basis[0, 1] + v * basis[1, 1] + basis[2, 1]
    dz = u * basis[0, 2] + v * basis[1, 2] + basis[2, 2]
    return dx, dy, dz


@njit(**INLINED)
def _read_ahead(ground, horizon, x, y):
    """Prefetch the data for a ray that hits the ground near (x, y)."""
    n, half = ground.n_half, ground.half_widths_m
    i = int((x * horizon.along_x + y * horizon.along_y + horizon.edge_m) * horizon.per_m)
    j = int((y * horizon.along_x - x * horizon.along_y + horizon.edge_m) * horizon.per_m)
    squares = horizon.clear_m.shape[0]
    if 0 <= i < squares and 0 <= j < squares:
        prefetch(horizon.clear_m, i * squares + j)
    d = max(abs(x), abs(y))
    if d < half[0]:
        per_step = n / half[0]
        column, row = int(x * per_step + n), int(y * per_step + n)
        at = row * (2 * n + 1) + column
        prefetch(ground.vertex, 4 * at)
        prefetch(ground.vertex, 4 * (at + 2 * n + 1))
        prefetch(ground.top_m, ground.level[0, 1] + (row >> 1) * n + (column >> 1))
    elif d < half[-1]:
        n_rings = len(half) - 1
        ring = any_ring_at(ground, d, n_rings - 1)
        if abs(x) >= abs(y):
            side, along = (1, y) if x > 0 else (3, -y)
        else:
            side, along = (2, -x) if y > 0 else (0, x)
        spoke = int((along / d + 1) * n)
        prefetch(ground.vertex, 4 * ring_vertex(ring, side * 2 * n + spoke, n))
        prefetch(ground.vertex, 4 * ring_vertex(ring + 1, side * 2 * n + spoke, n))
        prefetch(ground.top_m, ground.level[1, 1] + (side * ((n_rings + 1) >> 1) + (ring >> 1)) * n + (spoke >> 1))


@njit(**WITHOUT_COUNTS)
def see(ground, rocks, tops, view, tile):
    """Render a tile: cast its rays, and a shadow ray from each hit that may be dark.

    The results are written into the arrays of the tile. `tops` determines where the rays of a block of pixels begin.
    """
    n_samples, height, width, _ = tile.moved.shape
    origin, basis, (first_row, first_column) = view.origin, view.basis, tile.first
    near_m = ground.highest_m
    for row in range(0, height, BLOCK_PX):
        for column in range(0, width, BLOCK_PX):
            last_row, last_column = min(row + BLOCK_PX, height), min(column + BLOCK_PX, width)
            left, top = first_column + column, first_row + row
            rectangle = left, left + last_column - column, top, top + last_row - row
            begin = begin_m(tops, ground, origin, basis, rectangle)
            part = -1
            if begin < np.inf:
                part = only_part(ground, origin, basis, rectangle, begin)
                # Neighbouring rays hit at similar heights, so the last hit predicts which memory will be read.
                for i in range(row, last_row):
                    for j in range(column, last_column):
                        for s in range(n_samples):
                            u, v = _coordinates(tile, s, i, j)
                            dx, dy, dz = _direction(basis, u, v)
                            t = (near_m - origin[2]) / dz
                            _read_ahead(ground, view.horizon, origin[0] + t * dx, origin[1] + t * dy)
            # The samples of a pixel follow each other, since they read the same memory.
            for i in range(row, last_row):
                for j in range(column, last_column):
                    for s in range(n_samples):
                        near_m = _see(ground, rocks, view, tile, Block(begin, part), (s, i, j))


@njit(**WITHOUT_COUNTS)
def see_along(ground, rocks, view, tile, starts, rays):
    """Render a tile as `see`, with given rays (S, h, w, 3), O_L, of a lens model; a ray of NaN sees nothing.

    `starts` (S, h, w, 3) are the positions of the rays relative to the grid's centre, metres. `view.origin` and the
    last row of `view.basis` are overwritten; its other rows must be 0.
    """
    n_samples, height, width, _ = tile.moved.shape
    nowhere = Block(np.inf, -1)
    for i in range(height):
        for j in range(width):
            for s in range(n_samples):
                if np.isnan(rays[s, i, j, 0]):
                    if s == 0:
                        row, column = tile.first[0] + i, tile.first[1] + j
                        tile.depth[row, column] = np.inf
                        for axis in range(3):
                            tile.normal[row, column, axis] = 0.0
                    # The angles of a surface that faces camera and Sun, without albedo and in shadow.
                    for k in range(5):
                        tile.angles[k, s, i, j] = 1.0 if k < 3 else 0.0
                    continue
                for axis in range(3):
                    view.origin[axis], view.basis[2, axis] = starts[s, i, j, axis], rays[s, i, j, axis]
                _see(ground, rocks, view, tile, nowhere, (s, i, j))
