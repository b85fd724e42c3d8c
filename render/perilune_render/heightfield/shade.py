"""What each ray of an image sees: the hit, its shading, and whether the Sun reaches it."""

import numpy as np

from perilune_render.heightfield.cast import first_hit
from perilune_render.heightfield.surface import place_of, vertex
from perilune_render.provenance.kernels import njit

_LIFT = 1e-9
"""Start of a shadow ray, metres: its own triangle and boulder are left out, so it needs no margin."""
_TERMINATOR = 0.1
"""Cosine between ground and Sun below which Cycles moves the start of a shadow ray from the facet to the curved
surface that its vertex normals describe (its shadow terminator geometry offset, at its default)."""


@njit(inline="always", error_model="numpy")
def _dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(inline="always", error_model="numpy")
def _normal(vertices, k):
    """Unit normal of a vertex, which points upwards."""
    x, y = float(vertices[k, 0]), float(vertices[k, 1])
    return x, y, np.sqrt(max(1 - x * x - y * y, 0.0))


@njit(error_model="numpy")
def ground_at(ground, part, row, column, triangle, x, y, facet, curve):
    """Shading at a place of a triangle: normal, albedo.

    Writes the facet's unit normal into `facet` (3,), and into `curve` (3,) the vector by which Cycles lifts a grazing
    shadow ray from the facet: to the lowest of the vertices' tangent planes, each raised over the triangle, or to half
    the height of a quadratic patch that has the vertex normals.
    """
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
    u = 1 - v - w
    fx, fy, fz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, area
    length = 1 / np.sqrt(fx * fx + fy * fy + fz * fz)
    facet[0], facet[1], facet[2] = fx * length, fy * length, fz * length
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
    curve[0], curve[1], curve[2] = bulge * nx, bulge * ny, bulge * nz
    albedo = u * abs(vertices[v0, 3]) + v * abs(vertices[v1, 3]) + w * abs(vertices[v2, 3])
    length = 1 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * length, ny * length, nz * length, albedo


@njit(error_model="numpy")
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


@njit(error_model="numpy")
def see(ground, rocks, origin, rays, suns, sun, far_m, depth, normal, angles, lit):
    """Cast rays (N, 3) with z = 1 along the camera's axis from `origin` (3,), and a shadow ray from each hit.

    `suns` (N, 3) are unit vectors to points of the Sun's disc, `sun` (3,) to its centre. Writes for each ray the depth
    (inf for a miss), the unit shading normal (N, 3), `angles` (N, 4): mu0, mu, cosine of the phase angle, albedo, and
    `lit`: the cosine of incidence of the point of the disc, 0 in shadow.
    """
    facet, curve = np.empty(3), np.empty(3)
    nothing = (-1, -1, -1, -1, -1)
    for k in range(rays.shape[0]):
        dx, dy, dz = rays[k, 0], rays[k, 1], rays[k, 2]
        t, rock, face, part, row, column, triangle = first_hit(
            ground, rocks, origin[0], origin[1], origin[2], dx, dy, dz, 0.0, far_m, nothing
        )
        depth[k] = t
        lit[k] = 0.0
        if t == np.inf:
            normal[k, 0], normal[k, 1], normal[k, 2] = 0.0, 0.0, 0.0
            angles[k, 0], angles[k, 1], angles[k, 2], angles[k, 3] = 1.0, 1.0, 1.0, 0.0
            continue
        x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
        if rock >= 0:
            nx, ny, nz = rock_normal(rocks, rock, face)
            albedo = 1.0
            skip = (-1, -1, -1, -1, rock)
            facet[0], facet[1], facet[2] = nx, ny, nz
        else:
            nx, ny, nz, albedo = ground_at(ground, part, row, column, triangle, x, y, facet, curve)
            skip = (part, row, column, triangle, -1)
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        normal[k, 0], normal[k, 1], normal[k, 2] = nx, ny, nz
        angles[k, 0] = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 1e-4)
        angles[k, 1] = max(-(nx * dx + ny * dy + nz * dz) / length, 1e-4)
        angles[k, 2] = -(sun[0] * dx + sun[1] * dy + sun[2] * dz) / length
        angles[k, 3] = albedo
        lx, ly, lz = suns[k, 0], suns[k, 1], suns[k, 2]
        cosine = nx * lx + ny * ly + nz * lz
        if cosine <= 0:
            continue
        if rock < 0:
            on_facet = facet[0] * lx + facet[1] * ly + facet[2] * lz
            moved = 2 - (on_facet + cosine) / _TERMINATOR if cosine < _TERMINATOR else 1 - on_facet / _TERMINATOR
            moved = min(max(moved, 0.0), 1.0)
            if moved > 0:
                x, y, z = x + moved * curve[0], y + moved * curve[1], z + moved * curve[2]
        if first_hit(ground, rocks, x, y, z, lx, ly, lz, _LIFT, np.inf, skip)[0] == np.inf:
            lit[k] = cosine
