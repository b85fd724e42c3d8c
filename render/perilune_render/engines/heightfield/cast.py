"""Cast a ray onto the surface: the first point where it crosses the ground or enters a boulder.

A ray is cut where it enters another part of the mesh: at the border of the inner square and at the diagonals between
the sectors. In each part it walks from cell to cell. In a sector the borders of cells are straight lines too, so the
walk is exact. Blocks of the pyramid that lie below the ray are passed at once.

Ground is crossed where the ray's height over a triangle changes its sign, so no ray slips between two triangles.
"""

import numpy as np

from perilune_render.engines.heightfield.horizon import surely_lit
from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, ring_vertex
from perilune_render.provenance.kernels import njit

NO_PART = -1
"""Part of the mesh in a hit on nothing; 0 is the inner square, 1 to 4 are the sectors."""
_FIRST_LEVEL = 1
"""Level of the pyramid at which a walk begins."""
_BEHIND = 1e-6
"""Relative distance behind a ray's present place from which a line is taken as not ahead."""


@njit(**WITHOUT_COUNTS)
def enters_rock(rows, planes, k, ox, oy, oz, dx, dy, dz, t0, t1):
    """Parameter at which a ray enters boulder k between t0 and t1, and the face there; inf and -1 if it does not."""
    px, py, pz = ox - rows[k, 0], oy - rows[k, 1], oz - rows[k, 2]
    middle = -(px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz)
    cx, cy, cz = px + middle * dx, py + middle * dy, pz + middle * dz
    if cx * cx + cy * cy + cz * cz > rows[k, 12] ** 2:
        return np.inf, -1
    qx = rows[k, 3] * px + rows[k, 4] * py + rows[k, 5] * pz
    qy = rows[k, 6] * px + rows[k, 7] * py + rows[k, 8] * pz
    qz = rows[k, 9] * px + rows[k, 10] * py + rows[k, 11] * pz
    ex = rows[k, 3] * dx + rows[k, 4] * dy + rows[k, 5] * dz
    ey = rows[k, 6] * dx + rows[k, 7] * dy + rows[k, 8] * dz
    ez = rows[k, 9] * dx + rows[k, 10] * dy + rows[k, 11] * dz
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
    if t0 <= enter <= t1:
        return enter, face
    return np.inf, -1


@njit(inline="always", **WITHOUT_COUNTS)
def _first_rock(rocks, cell, ox, oy, oz, dx, dy, dz, t0, t1, skipped):
    """First boulder of a cell that a ray enters: parameter, boulder and face; inf, -1 and -1 if there is none."""
    best, rock, face = np.inf, -1, -1
    for at in range(rocks.cell_start[cell], rocks.cell_start[cell + 1]):
        k = rocks.cell_rock[at]
        if k != skipped:
            # A boulder reaches into other cells: a ray may enter it outside this one.
            t, f = enters_rock(rocks.rows, rocks.planes, k, ox, oy, oz, dx, dy, dz, t0, t1)
            if t < best:
                best, rock, face = t, k, f
    return best, rock, face


@njit(inline="always", **WITHOUT_COUNTS)
def crossing(above_0, above_1, t0, t1):
    """Parameter at which a height above a triangle, linear from t0 to t1, changes its sign; inf if it does not."""
    if (above_0 > 0) == (above_1 > 0):
        return np.inf
    return t0 + (t1 - t0) * above_0 / (above_0 - above_1)


@njit(**INLINED)
def _cross_inner(vertex, n, i, j, p0, dp, q0, dq, oz, dz, t0, t1, skipped_triangle):
    """Where a ray crosses the two triangles of a cell of the inner square: parameter and triangle; inf and -1."""
    low, high = j * (2 * n + 1) + i, (j + 1) * (2 * n + 1) + i
    h0, h1, h2, h3 = (
        float(vertex[low, 2]),
        float(vertex[low + 1, 2]),
        float(vertex[high + 1, 2]),
        float(vertex[high, 2]),
    )
    ax, ay, bx, by = h1 - h0, h2 - h1, h2 - h3, h3 - h0
    # On the first triangle, right of the diagonal, p - i >= q - j.
    s0, s1 = (p0 - i) - (q0 - j) + t0 * (dp - dq), (p0 - i) - (q0 - j) + t1 * (dp - dq)
    n_parts, split = 1, t1
    if (s0 > 0) != (s1 > 0):
        n_parts, split = 2, t0 + (t1 - t0) * s0 / (s0 - s1)
    start, triangle = t0, 0 if s0 + s1 > 0 else 1
    if n_parts == 2:
        triangle = 0 if s0 > 0 else 1
    for part in range(n_parts):
        end = t1 if part == n_parts - 1 else split
        gx, gy = (ax, ay) if triangle == 0 else (bx, by)
        slope = dz - gx * dp - gy * dq
        base = oz - h0 - gx * (p0 - i) - gy * (q0 - j)
        if triangle != skipped_triangle:
            t = crossing(base + start * slope, base + end * slope, start, end)
            if t < np.inf:
                return t, triangle
        start, triangle = end, 1 - triangle
    return np.inf, -1


@njit(**INLINED)
def _cross_sector(vertex, half_widths, n, side, ring, place, a0, da, d0, dd, oz, dz, t0, t1, skipped_triangle):
    """Where a ray crosses the two triangles of a cell of a sector: parameter and triangle; inf and -1."""
    along = side * 2 * n + place
    h0, h1 = float(vertex[ring_vertex(ring, along, n), 2]), float(vertex[ring_vertex(ring + 1, along, n), 2])
    h2, h3 = (
        float(vertex[ring_vertex(ring + 1, along + 1, n), 2]),
        float(vertex[ring_vertex(ring, along + 1, n), 2]),
    )
    near, far = half_widths[ring], half_widths[ring + 1]
    u0, u1 = place / n - 1, (place + 1) / n - 1
    a_first, a_last = near * u0, far * u1
    width = far - near
    # On the first triangle, with the vertex at far u0, this cross product is positive.
    s0 = (a_last - a_first) * (d0 + t0 * dd - near) - width * (a0 + t0 * da - a_first)
    s1 = (a_last - a_first) * (d0 + t1 * dd - near) - width * (a0 + t1 * da - a_first)
    n_parts, split = 1, t1
    if (s0 > 0) != (s1 > 0):
        n_parts, split = 2, t0 + (t1 - t0) * s0 / (s0 - s1)
    start, triangle = t0, 0 if s0 + s1 > 0 else 1
    if n_parts == 2:
        triangle = 0 if s0 > 0 else 1
    for part in range(n_parts):
        end = t1 if part == n_parts - 1 else split
        if triangle == 0:
            ga = (h2 - h1) * n / far
            gd = (h1 - h0) / width - ga * u0
        else:
            ga = (h3 - h0) * n / near
            gd = (h2 - h3) / width - ga * u1
        slope = dz - ga * da - gd * dd
        base = oz - h0 - ga * (a0 - a_first) - gd * (d0 - near)
        if triangle != skipped_triangle:
            t = crossing(base + start * slope, base + end * slope, start, end)
            if t < np.inf:
                return t, triangle
        start, triangle = end, 1 - triangle
    return np.inf, -1


@njit(**INLINED)
def _walk_inner(ground, rocks, horizon, ox, oy, oz, dx, dy, dz, t0, t1, skip):
    """The first hit in the inner square between t0 and t1; see `first_hit`."""
    n, coarsest = ground.n_half, ground.level[0, -1]
    cells = 2 * n
    step = ground.half_widths_m[0] / n
    p0, dp, q0, dq = ox / step + n, dx / step, oy / step + n, dy / step
    per_p, per_q = 1 / dp if dp != 0 else 0.0, 1 / dq if dq != 0 else 0.0
    t, rises = t0, dz > 0
    i = min(max(int(p0 + t * dp), 0), cells - 1)
    j = min(max(int(q0 + t * dq), 0), cells - 1)
    level = min(_FIRST_LEVEL, coarsest)
    best, best_rock, best_face, above = np.inf, -1, -1, False
    while t < t1:
        bi, bj = i >> level, j >> level
        tp = tq = np.inf
        if dp > 0:
            tp = (min((bi + 1) << level, cells) - p0) * per_p
        elif dp < 0:
            tp = ((bi << level) - p0) * per_p
        if dq > 0:
            tq = (min((bj + 1) << level, cells) - q0) * per_q
        elif dq < 0:
            tq = ((bj << level) - q0) * per_q
        end = max(min(min(tp, tq), t1), t)
        if level > 0:
            n_blocks = (cells + (1 << level) - 1) >> level
            top = ground.top_m[ground.level[0, level] + bj * n_blocks + bi]
            if min(oz + t * dz, oz + end * dz) <= top:
                level -= 1
                continue
            above = True
        else:
            if ground.vertex[j * (cells + 1) + i, 3] < 0:
                cell = j * cells + i
                tr, rock, face = _first_rock(rocks, cell, ox, oy, oz, dx, dy, dz, t0, t1, skip[4])
                if tr < best:
                    best, best_rock, best_face = tr, rock, face
            triangle = skip[3] if skip[0] == 0 and skip[1] == j and skip[2] == i else -1
            tg, triangle = _cross_inner(ground.vertex, n, i, j, p0, dp, q0, dq, oz, dz, t, end, triangle)
            if tg < best:
                return tg, -1, -1, 0, j, i, triangle
        if best <= end:
            break
        t = end
        if horizon is not None and above and surely_lit(horizon, ox + t * dx, oy + t * dy, oz + t * dz):
            return -np.inf, -1, -1, -1, -1, -1, -1
        if t >= t1:
            break
        if tp <= tq:
            i = min((bi + 1) << level, cells) if dp > 0 else (bi << level) - 1
            low = bj << level
            j = min(max(int(q0 + t * dq), low), min(((bj + 1) << level), cells) - 1)
        else:
            j = min((bj + 1) << level, cells) if dq > 0 else (bj << level) - 1
            low = bi << level
            i = min(max(int(p0 + t * dp), low), min(((bi + 1) << level), cells) - 1)
        if i < 0 or j < 0 or i >= cells or j >= cells:
            break
        # A ray that falls cannot pass the rest of a block whose beginning it could not pass.
        if level < coarsest and (rises or i >> (level + 1) != bi >> 1 or j >> (level + 1) != bj >> 1):
            level += 1
    if best < np.inf:
        return best, best_rock, best_face, 0, j, i, -1
    return np.inf, -1, -1, -1, -1, -1, -1


@njit(inline="always", **WITHOUT_COUNTS)
def _ring_at(half_widths, d, low, high):
    """Ring r of low..high with half_widths[r] <= d < half_widths[r + 1], the nearest of them if none."""
    while low < high:
        middle = (low + high + 1) >> 1
        if half_widths[middle] <= d:
            low = middle
        else:
            high = middle - 1
    return low


@njit(inline="always", **WITHOUT_COUNTS)
def any_ring_at(ground, d, high):
    """`_ring_at` among all rings, by a table."""
    half_widths, table = ground.half_widths_m, ground.ring
    ring = table[min(max(int((d - half_widths[0]) * ground.rings_per_m), 0), len(table) - 1)]
    while ring < high and half_widths[ring + 1] <= d:
        ring += 1
    while ring > 0 and half_widths[ring] > d:
        ring -= 1
    return ring


@njit(**INLINED)
def _walk_sector(ground, rocks, horizon, side, ox, oy, oz, dx, dy, dz, t0, t1, skip):
    """The first hit in a sector between t0 and t1; see `first_hit`."""
    n, coarsest = ground.n_half, ground.level[1, -1]
    n_rings, places = len(ground.half_widths_m) - 1, 2 * n
    half = ground.half_widths_m
    if side == 0:
        a0, da, d0, dd = ox, dx, -oy, -dy
    elif side == 1:
        a0, da, d0, dd = oy, dy, ox, dx
    elif side == 2:
        a0, da, d0, dd = -ox, -dx, oy, dy
    else:
        a0, da, d0, dd = -oy, -dy, -ox, -dx
    turning, per_d, per_n = da * d0 - a0 * dd, 1 / dd if dd != 0 else 0.0, 1 / n
    t, rises = t0, dz > 0
    d = d0 + t * dd
    ring = any_ring_at(ground, d, n_rings - 1)
    place = min(max(int(((a0 + t * da) / d + 1) * n), 0), places - 1)
    level = min(_FIRST_LEVEL, coarsest)
    best, best_rock, best_face, above = np.inf, -1, -1, False
    while t < t1:
        br, bp = ring >> level, place >> level
        first_ring, last_ring = br << level, min((br + 1) << level, n_rings)
        first_place, last_place = bp << level, min((bp + 1) << level, places)
        tr = tp = np.inf
        if dd > 0:
            tr = (half[last_ring] - d0) * per_d
        elif dd < 0:
            tr = (half[first_ring] - d0) * per_d
        if turning != 0:
            u = (last_place if turning > 0 else first_place) * per_n - 1
            slope = da - u * dd
            if slope != 0:
                tp = (u * d0 - a0) / slope
                if tp < t - _BEHIND * (abs(t) + 1):
                    # The line is crossed behind the ray's start, on its way towards the centre.
                    tp = np.inf
        end = max(min(min(tr, tp), t1), t)
        if level > 0:
            n_r, n_p = (n_rings + (1 << level) - 1) >> level, (places + (1 << level) - 1) >> level
            top = ground.top_m[ground.level[1, level] + (side * n_r + br) * n_p + bp]
            if min(oz + t * dz, oz + end * dz) <= top:
                level -= 1
                continue
            above = True
        else:
            if ground.vertex[ring_vertex(ring, side * places + place, n), 3] < 0:
                cell = 4 * n * n + (side * n_rings + ring) * places + place
                tk, rock, face = _first_rock(rocks, cell, ox, oy, oz, dx, dy, dz, t0, t1, skip[4])
                if tk < best:
                    best, best_rock, best_face = tk, rock, face
            triangle = skip[3] if skip[0] == side + 1 and skip[1] == ring and skip[2] == place else -1
            tg, triangle = _cross_sector(
                ground.vertex, half, n, side, ring, place, a0, da, d0, dd, oz, dz, t, end, triangle
            )
            if tg < best:
                return tg, -1, -1, side + 1, ring, place, triangle
        if best <= end:
            break
        t = end
        if horizon is not None and above and surely_lit(horizon, ox + t * dx, oy + t * dy, oz + t * dz):
            return -np.inf, -1, -1, -1, -1, -1, -1
        if t >= t1:
            break
        if tr <= tp:
            ring = last_ring if dd > 0 else first_ring - 1
            d = d0 + t * dd
            place = min(max(int(((a0 + t * da) / d + 1) * n), first_place), last_place - 1)
        else:
            place = last_place if turning > 0 else first_place - 1
            ring = _ring_at(half, d0 + t * dd, first_ring, last_ring - 1)
        if ring < 0 or place < 0 or ring >= n_rings or place >= places:
            break
        # A ray that falls cannot pass the rest of a block whose beginning it could not pass.
        if level < coarsest and (rises or ring >> (level + 1) != br >> 1 or place >> (level + 1) != bp >> 1):
            level += 1
    if best < np.inf:
        return best, best_rock, best_face, side + 1, ring, place, -1
    return np.inf, -1, -1, -1, -1, -1, -1


@njit(**INLINED)
def first_hit(ground, rocks, horizon, ox, oy, oz, dx, dy, dz, t0, t1, skip):
    """The first hit of the ray o + t d, relative to the grid's centre, with t0 < t < t1.

    `skip` is the triangle (part, row, column, triangle) and the boulder that the ray starts on, -1 for none. A ray to
    the Sun's disc may have its `horizon`, others None: where the ray comes to a place that is surely lit, nothing is
    ahead of it, and t is -inf. Returns
    t (inf for no hit), boulder and its face (-1 for the ground), and the cell: part (NO_PART, 0 for the inner square, 1
    to 4 for the sectors), row (y or ring), column (x or place), and triangle (-1 for a boulder).
    """
    half, outer = ground.half_widths_m[0], ground.half_widths_m[-1]
    for o, d in ((ox, dx), (oy, dy)):
        if d != 0:
            t_low, t_high = (-outer - o) / d, (outer - o) / d
            t0, t1 = max(t0, min(t_low, t_high)), min(t1, max(t_low, t_high))
        elif abs(o) > outer:
            return np.inf, -1, -1, -1, -1, -1, -1
    if dz < 0:
        t0, t1 = max(t0, (ground.highest_m - oz) / dz), min(t1, (ground.lowest_m - oz) / dz)
    elif dz > 0:
        t1 = min(t1, (ground.highest_m - oz) / dz)
    elif oz > ground.highest_m:
        t1 = -np.inf
    per_x, per_y = 1 / dx if dx != 0 else np.inf, 1 / dy if dy != 0 else np.inf
    cut_0 = (oy - ox) / (dx - dy) if dx != dy else np.inf
    cut_1 = -(ox + oy) / (dx + dy) if dx != -dy else np.inf
    cut_2, cut_3, cut_4, cut_5 = (half - ox) * per_x, (-half - ox) * per_x, (half - oy) * per_y, (-half - oy) * per_y
    start = t0
    while start < t1:
        end = t1
        for cut in (cut_0, cut_1, cut_2, cut_3, cut_4, cut_5):
            if start < cut < end:
                end = cut
        if end > start:
            middle = 0.5 * (start + end)
            x, y = ox + middle * dx, oy + middle * dy
            if max(abs(x), abs(y)) <= half:
                found = _walk_inner(ground, rocks, horizon, ox, oy, oz, dx, dy, dz, start, end, skip)
            elif abs(x) >= abs(y):
                side = 1 if x > 0 else 3
                found = _walk_sector(ground, rocks, horizon, side, ox, oy, oz, dx, dy, dz, start, end, skip)
            else:
                side = 2 if y > 0 else 0
                found = _walk_sector(ground, rocks, horizon, side, ox, oy, oz, dx, dy, dz, start, end, skip)
            if found[0] < np.inf:
                return found
        start = end
    return np.inf, -1, -1, -1, -1, -1, -1


@njit(**INLINED)
def first_hit_in_part(ground, rocks, part, ox, oy, oz, dx, dy, dz, t0, t1):
    """As `first_hit` without horizon for a ray whose way from t0 to the lowest ground is in one part of the mesh.

    It leaves out the tests of the parts' borders. The ray falls, and begins below the highest ground.
    """
    skip = -1, -1, -1, -1, -1
    t1 = min(t1, (ground.lowest_m - oz) / dz)
    if part == 0:
        return _walk_inner(ground, rocks, None, ox, oy, oz, dx, dy, dz, t0, t1, skip)
    return _walk_sector(ground, rocks, None, part - 1, ox, oy, oz, dx, dy, dz, t0, t1, skip)


@njit(**WITHOUT_COUNTS)
def first_hit_anywhere(ground, rocks, ox, oy, oz, dx, dy, dz, t0, t1):
    """As `first_hit` for a ray from above the ground, compiled apart, since it is rarely called in an image."""
    return first_hit(ground, rocks, None, ox, oy, oz, dx, dy, dz, t0, t1, (-1, -1, -1, -1, -1))
