"""Intersect a ray with the contents of a mesh cell: two triangles and the boulders that touch it.

Over a triangle, the ray's height above the ground is linear. The ray crosses the ground where this height changes
sign, so no ray slips between two triangles. A boulder is convex, so it is an intersection of half-spaces.
"""

from typing import NamedTuple

import numpy as np

from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, ring_vertex
from perilune_render.provenance.kernels import njit

NO_PART = -1
"""Value of `Facet.part` in `NO_FACET`."""


class Facet(NamedTuple):
    """A triangle of the ground, or a face of a boulder and the cell in which a ray enters it."""

    part: int
    """Part of the mesh: 0 for the inner square, 1 to 4 for the sectors."""
    row: int
    """Row of the cell along y; in a sector, its ring."""
    column: int
    """Column of the cell along x; in a sector, its spoke."""
    triangle: int
    """Triangle of the cell, 0 or 1; -1 for a boulder."""
    rock: int
    """Index of the boulder; -1 for the ground."""
    face: int
    """Index of the boulder's face in `Rocks.planes`; -1 for the ground."""


NO_FACET = Facet(NO_PART, -1, -1, -1, -1, -1)
"""Facet of a ray that hits nothing, or that does not start on the surface."""


class Ray(NamedTuple):
    """The ray (x, y, z) + t (dx, dy, dz).

    The coordinates are metres from the grid's centre, or coordinates of a part of the mesh.
    """

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float
    start: Facet
    """Facet on which the ray starts and which it cannot hit; `NO_FACET` for a ray from above the surface."""


@njit(**WITHOUT_COUNTS)
def enters_rock(rows, planes, k, ray, span):
    """Parameter within span, (t0, t1), at which a ray enters boulder k, and the face that it enters.

    Returns inf and -1 if the ray does not enter it. `rows` and `planes` are the fields of `Rocks`.
    """
    dx, dy, dz = ray.dx, ray.dy, ray.dz
    # First test a sphere around the boulder: most rays miss it.
    px, py, pz = ray.x - rows[k, 0], ray.y - rows[k, 1], ray.z - rows[k, 2]
    middle = -(px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)
    cx, cy, cz = px + middle * dx, py + middle * dy, pz + middle * dz
    if cx * cx + cy * cy + cz * cz > rows[k, 12] ** 2:
        return np.inf, -1
    # The ray in the boulder's axes, in units of its diameters: start q, direction e.
    qx = rows[k, 3] * px + rows[k, 4] * py + rows[k, 5] * pz
    qy = rows[k, 6] * px + rows[k, 7] * py + rows[k, 8] * pz
    qz = rows[k, 9] * px + rows[k, 10] * py + rows[k, 11] * pz
    ex = rows[k, 3] * dx + rows[k, 4] * dy + rows[k, 5] * dz
    ey = rows[k, 6] * dx + rows[k, 7] * dy + rows[k, 8] * dz
    ez = rows[k, 9] * dx + rows[k, 10] * dy + rows[k, 11] * dz
    # The ray is inside the boulder from where it enters the last half-space to where it leaves the first.
    enter, leave, face = -np.inf, np.inf, -1
    for f in range(int(rows[k, 13]), int(rows[k, 14])):
        nx, ny, nz = planes[f, 0], planes[f, 1], planes[f, 2]
        height = nx * qx + ny * qy + nz * qz - planes[f, 3]
        towards = nx * ex + ny * ey + nz * ez
        if towards < 0:
            t = -height / towards
            if t > enter:
                enter, face = t, f
        elif towards > 0:
            leave = min(leave, -height / towards)
        elif height > 0:
            return np.inf, -1
        if enter > leave:
            return np.inf, -1
    if span[0] <= enter <= span[1]:
        return enter, face
    return np.inf, -1


@njit(inline="always", **WITHOUT_COUNTS)
def first_rock(rocks, cell, ray, span):
    """First boulder of a cell that a ray enters: parameter, boulder and face; inf, -1 and -1 without one."""
    best, rock, face = np.inf, -1, -1
    for index in range(rocks.cell_start[cell], rocks.cell_start[cell + 1]):
        k = rocks.cell_rock[index]
        if k != ray.start.rock:
            # Use the whole span: a boulder extends into other cells, and the ray may enter it there.
            t, f = enters_rock(rocks.rows, rocks.planes, k, ray, span)
            if t < best:
                best, rock, face = t, k, f
    return best, rock, face


@njit(inline="always", **WITHOUT_COUNTS)
def crossing(above_0, above_1, t0, t1):
    """Parameter at which a height that is linear from t0 to t1 changes sign; inf if it keeps its sign."""
    if (above_0 > 0) == (above_1 > 0):
        return np.inf
    return t0 + (t1 - t0) * above_0 / (above_0 - above_1)


@njit(**INLINED)
def cross_inner(ground, row, column, ray, span):
    """Where a ray crosses the triangles of a cell of the inner square: parameter and triangle.

    Returns inf and -1 without a crossing. `ray` is in cells: x is a column, y a row, z a height in metres.
    """
    vertex, n, (t0, t1) = ground.vertex, ground.n_half, span
    p0, dp, q0, dq = ray.x, ray.dx, ray.y, ray.dy
    skipped = -1
    if ray.start.part == 0 and ray.start.row == row and ray.start.column == column:
        skipped = ray.start.triangle
    low, high = row * (2 * n + 1) + column, (row + 1) * (2 * n + 1) + column
    h0, h1, h2, h3 = (
        float(vertex[low, 2]),
        float(vertex[low + 1, 2]),
        float(vertex[high + 1, 2]),
        float(vertex[high, 2]),
    )
    # Slopes of the first and second triangle along the columns and along the rows.
    ax, ay, bx, by = h1 - h0, h2 - h1, h2 - h3, h3 - h0
    # Split the ray at the diagonal. The first triangle, right of the diagonal, has p - column >= q - row.
    s0, s1 = (p0 - column) - (q0 - row) + t0 * (dp - dq), (p0 - column) - (q0 - row) + t1 * (dp - dq)
    n_pieces, split = 1, t1
    if (s0 > 0) != (s1 > 0):
        n_pieces, split = 2, t0 + (t1 - t0) * s0 / (s0 - s1)
    begin, triangle = t0, 0 if s0 + s1 > 0 else 1
    if n_pieces == 2:
        triangle = 0 if s0 > 0 else 1
    for piece in range(n_pieces):
        end = t1 if piece == n_pieces - 1 else split
        gx, gy = (ax, ay) if triangle == 0 else (bx, by)
        slope = ray.dz - gx * dp - gy * dq
        base = ray.z - h0 - gx * (p0 - column) - gy * (q0 - row)
        if triangle != skipped:
            t = crossing(base + begin * slope, base + end * slope, begin, end)
            if t < np.inf:
                return t, triangle
        begin, triangle = end, 1 - triangle
    return np.inf, -1


@njit(**INLINED)
def cross_sector(ground, side, cell, ray, span):
    """Where a ray crosses the triangles of a cell (ring, spoke) of a sector: parameter and triangle.

    Returns inf and -1 without a crossing. `ray` is in the sector's coordinates: x is `along`, y is d, z a height,
    metres.
    """
    vertex, half_widths, n, (t0, t1) = ground.vertex, ground.half_widths_m, ground.n_half, span
    ring, spoke = cell
    a0, da, d0, dd = ray.x, ray.dx, ray.y, ray.dy
    skipped = -1
    if ray.start.part == side + 1 and ray.start.row == ring and ray.start.column == spoke:
        skipped = ray.start.triangle
    first = side * 2 * n + spoke
    h0, h1 = float(vertex[ring_vertex(ring, first, n), 2]), float(vertex[ring_vertex(ring + 1, first, n), 2])
    h2, h3 = (
        float(vertex[ring_vertex(ring + 1, first + 1, n), 2]),
        float(vertex[ring_vertex(ring, first + 1, n), 2]),
    )
    near, far = half_widths[ring], half_widths[ring + 1]
    u0, u1 = spoke / n - 1, (spoke + 1) / n - 1
    a_first, a_last = near * u0, far * u1
    width = far - near
    # Split the ray at the diagonal. This cross product is positive on the first triangle, with the vertex at far u0.
    s0 = (a_last - a_first) * (d0 + t0 * dd - near) - width * (a0 + t0 * da - a_first)
    s1 = (a_last - a_first) * (d0 + t1 * dd - near) - width * (a0 + t1 * da - a_first)
    n_pieces, split = 1, t1
    if (s0 > 0) != (s1 > 0):
        n_pieces, split = 2, t0 + (t1 - t0) * s0 / (s0 - s1)
    begin, triangle = t0, 0 if s0 + s1 > 0 else 1
    if n_pieces == 2:
        triangle = 0 if s0 > 0 else 1
    for piece in range(n_pieces):
        end = t1 if piece == n_pieces - 1 else split
        # Slopes of the triangle along the ring and along d.
        if triangle == 0:
            ga = (h2 - h1) * n / far
            gd = (h1 - h0) / width - ga * u0
        else:
            ga = (h3 - h0) * n / near
            gd = (h2 - h3) / width - ga * u1
        slope = ray.dz - ga * da - gd * dd
        base = ray.z - h0 - ga * (a0 - a_first) - gd * (d0 - near)
        if triangle != skipped:
            t = crossing(base + begin * slope, base + end * slope, begin, end)
            if t < np.inf:
                return t, triangle
        begin, triangle = end, 1 - triangle
    return np.inf, -1
