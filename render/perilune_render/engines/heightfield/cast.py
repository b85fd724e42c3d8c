r"""Cast a ray onto the surface: the first point where it crosses the ground or enters a boulder.

The mesh from above, with y upwards. Diagonals separate the sectors (`surface` has their coordinates):

        +-----------+
        | \   3   / |      part 0: inner square; a cell has a row (y) and a column (x)
        |  +-----+  |      parts 1 to 4: sectors; a cell has a ring (row) and a spoke (column)
        | 4|  0  |2 |
        |  +-----+  |      `side` is the part less 1
        | /   1   \ |
        +-----------+

`first_hit` cuts a ray at the border of the inner square and at the diagonals, and walks through one part after another:

1. `_walk_inner`, `_walk_sector`: convert the ray to the coordinates of the part. In them, the borders of cells are
   straight lines, so the walk is exact. Step from block to block of the pyramid of largest heights:

       ray  \
             \  =======    the ray stays above the block: pass it, and try a block of twice the size
        ======\=           the ray comes below the block's highest point: try a block of half the size
               \_____      level 0: a single cell

2. `first_rock` (`cell`): in a cell, intersect the boulders that touch it.
3. `cross_inner`, `cross_sector` (`cell`): in a cell, intersect its two triangles.

The kernels are compiled into one function. Vectors are written out as scalars, since only scalars stay in registers.
"""

import numpy as np

from perilune_render.engines.heightfield.cell import NO_FACET, Facet, Ray, cross_inner, cross_sector, first_rock
from perilune_render.engines.heightfield.horizon import surely_lit
from perilune_render.engines.heightfield.surface import INLINED, WITHOUT_COUNTS, ring_vertex
from perilune_render.provenance.kernels import njit

_FIRST_LEVEL = 1
"""Level of the pyramid at which a walk begins."""
_BEHIND = 1e-6
"""Relative tolerance for rounding: a crossing this little behind the ray's current point still counts as ahead."""


@njit(**INLINED)
def _walk_inner(ground, rocks, horizon, ray, span):
    """The first hit in the inner square within span, (t0, t1); arguments as in `first_hit`."""
    n, coarsest = ground.n_half, ground.level[0, -1]
    cells = 2 * n
    t, t1 = span
    # The ray in cells: p is a column, q a row.
    step = ground.half_widths_m[0] / n
    p0, dp, q0, dq = ray.x / step + n, ray.dx / step, ray.y / step + n, ray.dy / step
    in_cells = Ray(p0, q0, ray.z, dp, dq, ray.dz, ray.start)
    per_p, per_q = 1 / dp if dp != 0 else 0.0, 1 / dq if dq != 0 else 0.0
    rises = ray.dz > 0
    i = min(max(int(p0 + t * dp), 0), cells - 1)
    j = min(max(int(q0 + t * dq), 0), cells - 1)
    level = min(_FIRST_LEVEL, coarsest)
    best, best_rock, best_face, above = np.inf, -1, -1, False
    while t < t1:
        # Where the ray leaves the block (bi, bj): tp through a column's border, tq through a row's.
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
            if min(ray.z + t * ray.dz, ray.z + end * ray.dz) <= top:
                level -= 1
                continue
            above = True
        else:
            # A negative albedo marks a cell that boulders touch.
            if ground.vertex[j * (cells + 1) + i, 3] < 0:
                tr, rock, face = first_rock(rocks, j * cells + i, ray, span)
                if tr < best:
                    best, best_rock, best_face = tr, rock, face
            tg, triangle = cross_inner(ground, j, i, in_cells, (t, end))
            if tg < best:
                return tg, Facet(0, j, i, triangle, -1, -1)
        # Ground in the next blocks may hide a boulder that is hit beyond this block, so stop only for a nearer hit.
        if best <= end:
            break
        t = end
        # Near the ray's start, `surely_lit` is the same as at the start. Test it only after the ray has passed a block.
        if horizon is not None and above and _lit_at(horizon, ray, t):
            return -np.inf, NO_FACET
        if t >= t1:
            break
        # Step over the nearer border. Clip the other index to the block, since rounding could move it outside.
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
        # A falling ray only gets lower: if it came below the top of the larger block before, it still does.
        if level < coarsest and (rises or i >> (level + 1) != bi >> 1 or j >> (level + 1) != bj >> 1):
            level += 1
    if best < np.inf:
        return best, Facet(0, j, i, -1, best_rock, best_face)
    return np.inf, NO_FACET


@njit(inline="always", **WITHOUT_COUNTS)
def _lit_at(horizon, ray, t):
    """Whether the point of a ray at parameter t is surely lit."""
    return surely_lit(horizon, ray.x + t * ray.dx, ray.y + t * ray.dy, ray.z + t * ray.dz)


@njit(inline="always", **WITHOUT_COUNTS)
def _ring_at(half_widths, d, low, high):
    """Ring r of low..high with half_widths[r] <= d < half_widths[r + 1], clipped to low and high."""
    while low < high:
        middle = (low + high + 1) >> 1
        if half_widths[middle] <= d:
            low = middle
        else:
            high = middle - 1
    return low


@njit(inline="always", **WITHOUT_COUNTS)
def any_ring_at(ground, d, high):
    """Like `_ring_at` for all rings up to `high`, but starts from the table `Ground.ring`."""
    half_widths, table = ground.half_widths_m, ground.ring
    ring = table[min(max(int((d - half_widths[0]) * ground.rings_per_m), 0), len(table) - 1)]
    while ring < high and half_widths[ring + 1] <= d:
        ring += 1
    while ring > 0 and half_widths[ring] > d:
        ring -= 1
    return ring


@njit(**INLINED)
def _walk_sector(ground, rocks, horizon, side, ray, span):
    """The first hit in a sector within span, (t0, t1); arguments as in `first_hit`."""
    n, coarsest = ground.n_half, ground.level[1, -1]
    n_rings, spokes = len(ground.half_widths_m) - 1, 2 * n
    half = ground.half_widths_m
    t, t1 = span
    # The ray in the sector's coordinates: a along the side, d the distance.
    if side == 0:
        a0, da, d0, dd = ray.x, ray.dx, -ray.y, -ray.dy
    elif side == 1:
        a0, da, d0, dd = ray.y, ray.dy, ray.x, ray.dx
    elif side == 2:
        a0, da, d0, dd = -ray.x, -ray.dx, ray.y, ray.dy
    else:
        a0, da, d0, dd = -ray.y, -ray.dy, -ray.x, -ray.dx
    in_sector = Ray(a0, d0, ray.z, da, dd, ray.dz, ray.start)
    # Spokes meet at the centre. `turning` is positive if the ray crosses them in ascending order, else negative.
    turning, per_d, per_n = da * d0 - a0 * dd, 1 / dd if dd != 0 else 0.0, 1 / n
    rises = ray.dz > 0
    d = d0 + t * dd
    ring = any_ring_at(ground, d, n_rings - 1)
    spoke = min(max(int(((a0 + t * da) / d + 1) * n), 0), spokes - 1)
    level = min(_FIRST_LEVEL, coarsest)
    best, best_rock, best_face, above = np.inf, -1, -1, False
    while t < t1:
        # Where the ray leaves the block (br, bs): tr through a ring, ts through a spoke.
        br, bs = ring >> level, spoke >> level
        first_ring, last_ring = br << level, min((br + 1) << level, n_rings)
        first_spoke, last_spoke = bs << level, min((bs + 1) << level, spokes)
        tr = ts = np.inf
        if dd > 0:
            tr = (half[last_ring] - d0) * per_d
        elif dd < 0:
            tr = (half[first_ring] - d0) * per_d
        if turning != 0:
            u = (last_spoke if turning > 0 else first_spoke) * per_n - 1
            slope = da - u * dd
            if slope != 0:
                ts = (u * d0 - a0) / slope
                if ts < t - _BEHIND * (abs(t) + 1):
                    # The crossing lies behind the current point, so the ray does not cross this spoke in the sector.
                    ts = np.inf
        end = max(min(min(tr, ts), t1), t)
        if level > 0:
            n_r, n_s = (n_rings + (1 << level) - 1) >> level, (spokes + (1 << level) - 1) >> level
            top = ground.top_m[ground.level[1, level] + (side * n_r + br) * n_s + bs]
            if min(ray.z + t * ray.dz, ray.z + end * ray.dz) <= top:
                level -= 1
                continue
            above = True
        else:
            # A negative albedo marks a cell that boulders touch.
            if ground.vertex[ring_vertex(ring, side * spokes + spoke, n), 3] < 0:
                cell = 4 * n * n + (side * n_rings + ring) * spokes + spoke
                tk, rock, face = first_rock(rocks, cell, ray, span)
                if tk < best:
                    best, best_rock, best_face = tk, rock, face
            tg, triangle = cross_sector(ground, side, (ring, spoke), in_sector, (t, end))
            if tg < best:
                return tg, Facet(side + 1, ring, spoke, triangle, -1, -1)
        # Ground in the next blocks may hide a boulder that is hit beyond this block, so stop only for a nearer hit.
        if best <= end:
            break
        t = end
        # Near the ray's start, `surely_lit` is the same as at the start. Test it only after the ray has passed a block.
        if horizon is not None and above and _lit_at(horizon, ray, t):
            return -np.inf, NO_FACET
        if t >= t1:
            break
        # Step over the nearer border. Clip the other index to the block, since rounding could move it outside.
        if tr <= ts:
            ring = last_ring if dd > 0 else first_ring - 1
            d = d0 + t * dd
            spoke = min(max(int(((a0 + t * da) / d + 1) * n), first_spoke), last_spoke - 1)
        else:
            spoke = last_spoke if turning > 0 else first_spoke - 1
            ring = _ring_at(half, d0 + t * dd, first_ring, last_ring - 1)
        if ring < 0 or spoke < 0 or ring >= n_rings or spoke >= spokes:
            break
        # A falling ray only gets lower: if it came below the top of the larger block before, it still does.
        if level < coarsest and (rises or ring >> (level + 1) != br >> 1 or spoke >> (level + 1) != bs >> 1):
            level += 1
    if best < np.inf:
        return best, Facet(side + 1, ring, spoke, -1, best_rock, best_face)
    return np.inf, NO_FACET


@njit(**INLINED)
def first_hit(ground, rocks, horizon, ray, span):
    """The first hit of a ray within span, (t0, t1): its parameter t and the facet.

    Returns inf and `NO_FACET` without a hit. For a ray to the Sun's disc, `horizon` may be the Sun's horizon. If the
    ray then reaches a point that is surely lit, no hit lies ahead, and t is -inf. For other rays, `horizon` is None.
    """
    (x, y, z, dx, dy, dz, _), (t0, t1) = ray, span
    half, outer = ground.half_widths_m[0], ground.half_widths_m[-1]
    # Clip the ray to the box around the surface.
    for o, d in ((x, dx), (y, dy)):
        if d != 0:
            t_low, t_high = (-outer - o) / d, (outer - o) / d
            t0, t1 = max(t0, min(t_low, t_high)), min(t1, max(t_low, t_high))
        elif abs(o) > outer:
            return np.inf, NO_FACET
    if dz < 0:
        t0, t1 = max(t0, (ground.highest_m - z) / dz), min(t1, (ground.lowest_m - z) / dz)
    elif dz > 0:
        t1 = min(t1, (ground.highest_m - z) / dz)
    elif z > ground.highest_m:
        t1 = -np.inf
    # Cut it at the diagonals (0, 1) and at the border of the inner square (2 to 5).
    per_x, per_y = 1 / dx if dx != 0 else np.inf, 1 / dy if dy != 0 else np.inf
    cut_0 = (y - x) / (dx - dy) if dx != dy else np.inf
    cut_1 = -(x + y) / (dx + dy) if dx != -dy else np.inf
    cut_2, cut_3, cut_4, cut_5 = (half - x) * per_x, (-half - x) * per_x, (half - y) * per_y, (-half - y) * per_y
    begin = t0
    while begin < t1:
        end = t1
        for cut in (cut_0, cut_1, cut_2, cut_3, cut_4, cut_5):
            if begin < cut < end:
                end = cut
        if end > begin:
            # The middle of a piece determines its part of the mesh, since the ends are on borders.
            middle = 0.5 * (begin + end)
            mx, my = x + middle * dx, y + middle * dy
            if max(abs(mx), abs(my)) <= half:
                hit = _walk_inner(ground, rocks, horizon, ray, (begin, end))
            elif abs(mx) >= abs(my):
                side = 1 if mx > 0 else 3
                hit = _walk_sector(ground, rocks, horizon, side, ray, (begin, end))
            else:
                side = 2 if my > 0 else 0
                hit = _walk_sector(ground, rocks, horizon, side, ray, (begin, end))
            if hit[0] < np.inf:
                return hit
        begin = end
    return np.inf, NO_FACET


@njit(**INLINED)
def first_hit_in_part(ground, rocks, part, ray, span):
    """Like `first_hit` without horizon, for a ray that stays in one part of the mesh.

    The borders of the parts are not tested. From t0, the ray must fall, begin below the highest ground, and stay in the
    part down to the lowest ground.
    """
    piece = span[0], min(span[1], (ground.lowest_m - ray.z) / ray.dz)
    if part == 0:
        return _walk_inner(ground, rocks, None, ray, piece)
    return _walk_sector(ground, rocks, None, part - 1, ray, piece)


@njit(**WITHOUT_COUNTS)
def first_hit_anywhere(ground, rocks, ray, span):
    """Like `first_hit` without horizon, but compiled separately, since an image rarely needs it."""
    return first_hit(ground, rocks, None, ray, span)
