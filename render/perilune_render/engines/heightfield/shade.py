"""What each ray of an image sees: the hit, its shading, and whether the Sun reaches it."""

import numpy as np

from perilune_render.engines.heightfield.beam import BLOCK_PX, begin_m, only_part
from perilune_render.engines.heightfield.cast import any_ring_at, first_hit, first_hit_anywhere, first_hit_in_part
from perilune_render.engines.heightfield.horizon import surely_lit
from perilune_render.engines.heightfield.prefetch import prefetch
from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, place_of, ring_vertex, vertex
from perilune_render.provenance.kernels import njit

_LIFT = 1e-4
"""Start of a shadow ray, metres. Its own triangle and boulder are left out; a ray from an edge of its triangle must not
hit the next one by rounding."""
_TERMINATOR = 0.1
"""Cosine between ground and Sun below which Cycles moves the start of a shadow ray from the facet to the curved
surface that its vertex normals describe (its shadow terminator geometry offset, at its default)."""


@njit(inline="always", **WITHOUT_COUNTS)
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(inline="always", **WITHOUT_COUNTS)
def _normal(vertices, k):
    """Unit normal of a vertex, which points upwards."""
    x, y = float(vertices[k, 0]), float(vertices[k, 1])
    return x, y, np.sqrt(max(1 - x * x - y * y, 0.0))


@njit(inline="always", **WITHOUT_COUNTS)
def _corners(ground, part, row, column, triangle, x, y):
    """Of a triangle: its vertices, the edges from the first to the others, their cross product's z, and the weights of
    the second and third vertex at a place."""
    n, half, vertices = ground.n_half, ground.half_widths_m, ground.vertex
    a, b = (1, 2) if triangle == 0 else (2, 3)
    v0, v1, v2 = (
        vertex(part, row, column, 0, n),
        vertex(part, row, column, a, n),
        vertex(part, row, column, b, n),
    )
    x0, y0 = place_of(part, row, column, 0, n, half)
    x1, y1 = place_of(part, row, column, a, n, half)
    x2, y2 = place_of(part, row, column, b, n, half)
    e1x, e1y, e1z = x1 - x0, y1 - y0, float(vertices[v1, 2] - vertices[v0, 2])
    e2x, e2y, e2z = x2 - x0, y2 - y0, float(vertices[v2, 2] - vertices[v0, 2])
    area = e1x * e2y - e1y * e2x
    v = ((x - x0) * e2y - (y - y0) * e2x) / area
    w = (e1x * (y - y0) - e1y * (x - x0)) / area
    return v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, area, v, w


@njit(**INLINED)
def ground_at(ground, part, row, column, triangle, x, y):
    """Shading at a place of a triangle: unit normal, albedo, and the unit normal of the triangle."""
    vertices = ground.vertex
    v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, area, v, w = _corners(ground, part, row, column, triangle, x, y)
    u = 1 - v - w
    fx, fy, fz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, area
    size = 1 / np.sqrt(fx * fx + fy * fy + fz * fz)
    ax, ay, az = _normal(vertices, v0)
    bx, by, bz = _normal(vertices, v1)
    cx, cy, cz = _normal(vertices, v2)
    nx, ny, nz = u * ax + v * bx + w * cx, u * ay + v * by + w * cy, u * az + v * bz + w * cz
    albedo = u * abs(vertices[v0, 3]) + v * abs(vertices[v1, 3]) + w * abs(vertices[v2, 3])
    length = 1 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * length, ny * length, nz * length, albedo, fx * size, fy * size, fz * size


@njit(**INLINED)
def lift_at(ground, part, row, column, triangle, x, y):
    """The vector by which Cycles lifts a grazing shadow ray at a place of a triangle from the facet.

    It is that to the lowest of the vertices' tangent planes, each raised over the triangle, or to half the height of a
    quadratic patch that has the vertex normals.
    """
    vertices = ground.vertex
    v0, v1, v2, e1x, e1y, e1z, e2x, e2y, e2z, _, v, w = _corners(ground, part, row, column, triangle, x, y)
    u = 1 - v - w
    ax, ay, az = _normal(vertices, v0)
    bx, by, bz = _normal(vertices, v1)
    cx, cy, cz = _normal(vertices, v2)
    nx, ny, nz = u * ax + v * bx + w * cx, u * ay + v * by + w * cy, u * az + v * bz + w * cz
    # A patch that is normal to the vertex normals bulges over an edge by its length times the change of slope.
    edge_1 = (bx - ax) * e1x + (by - ay) * e1y + (bz - az) * e1z
    edge_2 = (cx - ax) * e2x + (cy - ay) * e2y + (cz - az) * e2z
    edge_3 = (cx - bx) * (e2x - e1x) + (cy - by) * (e2y - e1y) + (cz - bz) * (e2z - e1z)
    bulge = u * v * edge_1 + u * w * edge_2 + v * w * edge_3
    # The tangent plane of each vertex, raised over the other two vertices: its height above the place.
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
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@njit(**INLINED)
def _see(ground, rocks, horizon, view, drawn, begin, below, first, s, i, j, out):
    """Cast the ray of one sample, which begins at the height `begin`, and its shadow ray; see `see`.

    `below` is the part of the mesh below the ray, -1 if it is not known (`only_part`).
    Returns the height of the hit, or `begin` if there is none.
    """
    (origin, basis, sun, plane, far_m), (moved, disc), (depth, normal, angles) = view, drawn, out
    u, v = first[1] + j + 0.5 + moved[s, i, j, 0], first[0] + i + 0.5 + moved[s, i, j, 1]
    dx = u * basis[0, 0] + v * basis[1, 0] + basis[2, 0]
    dy = u * basis[0, 1] + v * basis[1, 1] + basis[2, 1]
    dz = u * basis[0, 2] + v * basis[1, 2] + basis[2, 2]
    start = max((begin - origin[2]) / dz, 0.0) if begin < np.inf else 0.0
    ox, oy, oz = origin[0], origin[1], origin[2]
    if below >= 0:
        hit = first_hit_in_part(ground, rocks, below, ox, oy, oz, dx, dy, dz, start, far_m)
    else:
        hit = first_hit_anywhere(ground, rocks, ox, oy, oz, dx, dy, dz, start, far_m)
    t, rock, face, part, row, column, triangle = hit
    nx, ny, nz, albedo, fx, fy, fz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
    hit_z = z if t < np.inf else begin
    if rock >= 0:
        nx, ny, nz = rock_normal(rocks, rock, face)
        albedo = 1.0
    elif t < np.inf:
        nx, ny, nz, albedo, fx, fy, fz = ground_at(ground, part, row, column, triangle, x, y)
    if s == 0:
        at = first[0] + i, first[1] + j
        depth[at], normal[at[0], at[1], 0], normal[at[0], at[1], 1], normal[at[0], at[1], 2] = t, nx, ny, nz
    p, q = disc[s, i, j, 0], disc[s, i, j, 1]
    lx, ly = sun[0] + p * plane[0, 0] + q * plane[1, 0], sun[1] + p * plane[0, 1] + q * plane[1, 1]
    lz = sun[2] + p * plane[0, 2] + q * plane[1, 2]
    to_disc = 1 / np.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx * to_disc, ly * to_disc, lz * to_disc
    per_length = 1 / np.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = nx * lx + ny * ly + nz * lz
    angles[0, s, i, j] = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 1e-4)
    angles[1, s, i, j] = max(-(nx * dx + ny * dy + nz * dz) * per_length, 1e-4)
    angles[2, s, i, j] = -(sun[0] * dx + sun[1] * dy + sun[2] * dz) * per_length
    angles[3, s, i, j] = albedo
    angles[4, s, i, j] = 0.0
    if cosine <= 0:
        return hit_z
    skip = (-1, -1, -1, -1, rock)
    if rock < 0:
        skip = (part, row, column, triangle, -1)
        on_facet = fx * lx + fy * ly + fz * lz
        moves = 2 - (on_facet + cosine) / _TERMINATOR if cosine < _TERMINATOR else 1 - on_facet / _TERMINATOR
        moves = min(max(moves, 0.0), 1.0)
        if moves > 0:
            mx, my, mz = lift_at(ground, part, row, column, triangle, x, y)
            x, y, z = x + moves * mx, y + moves * my, z + moves * mz
        elif surely_lit(horizon, x, y, z):
            angles[4, s, i, j] = cosine
            return hit_z
    if abs(first_hit(ground, rocks, horizon, x, y, z, lx, ly, lz, _LIFT, np.inf, skip)[0]) == np.inf:
        angles[4, s, i, j] = cosine
    return hit_z


@njit(**INLINED)
def _read_ahead(ground, horizon, x, y):
    """Begin to read what a ray needs that hits the ground near a place."""
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
        place = int((along / d + 1) * n)
        prefetch(ground.vertex, 4 * ring_vertex(ring, side * 2 * n + place, n))
        prefetch(ground.vertex, 4 * ring_vertex(ring + 1, side * 2 * n + place, n))
        prefetch(ground.top_m, ground.level[1, 1] + (side * ((n_rings + 1) >> 1) + (ring >> 1)) * n + (place >> 1))


@njit(**WITHOUT_COUNTS)
def see(ground, rocks, tops, horizon, origin, basis, sun, plane, far_m, first, moved, disc, depth, normal, angles):
    """Cast the rays of a tile of the image from `origin` (3,), and a shadow ray from each hit that may be dark.

    The ray at image coordinates (u, v) is u basis[0] + v basis[1] + basis[2], with z = 1 along the camera's axis.
    `tops` tells where the rays of a block of pixels begin. `first` is the tile's first row and column. `moved`
    (S, h, w, 2) has the places of its samples, pixels from the pixel's centre. `disc` (S, h, w, 2) has places on the
    Sun's disc: a ray there is along the unit vector `sun` (3,) to the centre, plus the place times `plane` (2, 3).
    Writes for the first sample the depth (inf for a miss) and the unit shading normal into the images `depth` and
    `normal`. Writes for each sample `angles` (5, S, h, w): mu0, mu, cosine of the phase angle, albedo, and the cosine
    of incidence of the point of the disc, 0 in shadow.
    The samples of a pixel come one after another, since they read the same memory.
    """
    n_samples, height, width, _ = moved.shape
    near_m = ground.highest_m
    view, drawn, out = (origin, basis, sun, plane, far_m), (moved, disc), (depth, normal, angles)
    for row in range(0, height, BLOCK_PX):
        for column in range(0, width, BLOCK_PX):
            last_row, last_column = min(row + BLOCK_PX, height), min(column + BLOCK_PX, width)
            u, v = first[1] + column, first[0] + row
            last_u, last_v = u + last_column - column, v + last_row - row
            begin = begin_m(tops, ground, origin, basis, u, last_u, v, last_v)
            below = -1
            if begin < np.inf:
                below = only_part(ground, origin, basis, u, last_u, v, last_v, begin)
                # Close rays hit at similar heights, so the last hit says where memory will be read.
                for i in range(row, last_row):
                    for j in range(column, last_column):
                        for s in range(n_samples):
                            u, v = first[1] + j + 0.5 + moved[s, i, j, 0], first[0] + i + 0.5 + moved[s, i, j, 1]
                            dx = u * basis[0, 0] + v * basis[1, 0] + basis[2, 0]
                            dy = u * basis[0, 1] + v * basis[1, 1] + basis[2, 1]
                            dz = u * basis[0, 2] + v * basis[1, 2] + basis[2, 2]
                            t = (near_m - origin[2]) / dz
                            _read_ahead(ground, horizon, origin[0] + t * dx, origin[1] + t * dy)
            for i in range(row, last_row):
                for j in range(column, last_column):
                    for s in range(n_samples):
                        near_m = _see(ground, rocks, horizon, view, drawn, begin, below, first, s, i, j, out)
