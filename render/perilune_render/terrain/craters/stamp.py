"""Stamp craters on the ground, oldest first, each in its own window (compiled by numba)."""

from dataclasses import dataclass

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.profile import REACH, crest_radius, profile_tables, wear_row
from perilune_render.terrain.grid import Grid, lines_in, place_in_ring, vertex_of_ring
from perilune_shared.geometry.frames import Array

_N_RIM = 16


@dataclass(frozen=True, slots=True)
class Laid:
    """Results of stamping N craters."""

    sag_m: Array
    """Height difference from rim to centre of the older ground that remains under each crater, metres (N,). It is not
    depth of the crater itself."""
    rim_left: Array
    """Share of each crater's rim that younger craters have not removed (N,)."""


def stamp_craters(
    height_m: Array, albedo: Array, grid: Grid, craters: Craters, brightness: Array, profile: str = "fassett_thomson"
) -> Laid:
    """Stamp `craters` on height_m (n_vertices,) and brighten albedo (n_vertices,), both in place.

    A crater first replaces the ground below it by a plane fitted to it, to a degree that falls with the crater's wear,
    and then adds its own profile. `brightness` (N,) is the relative brightening within the rim.
    """
    tables = profile_tables(profile)
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    # The label's circle is the current crest; the profile is scaled by the fresh crest's radius.
    grown = crest_radius(wear, craters.fresh_depth_m / craters.rim_height_m, profile)
    sag, rim_left = _stamp(
        height_m,
        albedo,
        grid.n_half,
        grid.half_widths_m,
        craters.x_m,
        craters.y_m,
        craters.diameter_m / 2 / grown,
        craters.diameter_m / 2,
        craters.fresh_depth_m,
        craters.rim_height_m,
        wear_row(wear),
        craters.flat_floor,
        craters.outline,
        craters.crest,
        brightness,
        tables.rim,
        np.stack([tables.bowl, tables.flat_bowl]),
        tables.removed,
    )
    return Laid(sag, rim_left)


@njit()
def _nearest(x, y, n_half, half_widths):
    """Index of a vertex near a place, or -1 outside the grid."""
    n = n_half
    distance = max(abs(x), abs(y))
    if distance > half_widths[-1]:
        return -1
    if distance <= half_widths[0]:
        step = half_widths[0] / n
        return (int(np.rint(y / step)) + n) * (2 * n + 1) + int(np.rint(x / step)) + n
    return vertex_of_ring(np.searchsorted(half_widths, distance), int(np.rint(place_in_ring(x, y, n))), n)


@njit()
def _chord(lines, line, x, y, reach):
    """The part of a line within `reach` of (x, y).

    Returns the line's start relative to (x, y), its steps in x and y, the index of its first vertex, and the range of
    positions on the line (start, stop).
    """
    dx, dy = lines[line, 0] - x, lines[line, 1] - y
    step_x, step_y = lines[line, 2], lines[line, 3]
    along, across = (dx, dy) if step_y == 0 else (dy, dx)
    square = reach * reach - across * across
    if square < 0:
        return dx, dy, step_x, step_y, 0, 0, 0
    half, step = np.sqrt(square), step_x + step_y
    low, high = min((-half - along) / step, (half - along) / step), max((-half - along) / step, (half - along) / step)
    last = min(int(np.floor(high)) + 1, int(lines[line, 5]))
    return dx, dy, step_x, step_y, int(lines[line, 4]), max(int(np.ceil(low)), 0), last


@njit()
def _stamp(
    height,
    albedo,
    n_half,
    half_widths,
    x,
    y,
    radius,
    label_radius,
    depth,
    rim_height,
    wear_row,
    flat_floor,
    outline,
    crest,
    brightness,
    rim,
    bowls,
    removed,
):
    columns = rim.shape[1]
    per_radius = (columns - 1) / REACH
    own_rim, own_bowl, gone = np.empty(columns), np.empty(columns), np.empty(columns)
    lines = np.empty((2 * n_half + 1 + 4 * len(half_widths), 7))
    sag = np.zeros(len(x))
    # Logarithm of the share of the initial ground that is left at each vertex. The difference of two values is the loss
    # of a rim since it was stamped.
    log_left = np.zeros(len(height))
    rim_vertex = np.full((len(x), _N_RIM), -1)
    rim_before = np.zeros((len(x), _N_RIM))
    for k in range(len(x)):
        upper = min(int(wear_row[k]), rim.shape[0] - 2)
        share = wear_row[k] - upper
        bowl = bowls[1] if flat_floor[k] else bowls[0]
        for c in range(columns):
            own_rim[c] = rim_height[k] * (rim[upper, c] * (1 - share) + rim[upper + 1, c] * share)
            own_bowl[c] = depth[k] * (bowl[upper, c] * (1 - share) + bowl[upper + 1, c] * share)
            gone[c] = removed[upper, c] * (1 - share) + removed[upper + 1, c] * share
        reach = REACH * radius[k]
        count = lines_in(x[k] - reach, x[k] + reach, y[k] - reach, y[k] + reach, n_half, half_widths, lines)
        # Least-squares plane of the ground within 1.3 radii, about the crater's centre.
        s0 = sx = sy = sxx = sxy = syy = sh = sxh = syh = 0.0
        n_rim = n_floor = h_rim = h_floor = 0.0
        square_r = radius[k] ** 2
        for line in range(count):
            dx, dy, step_x, step_y, first, start, stop = _chord(lines, line, x[k], y[k], 1.3 * radius[k])
            for p in range(start, stop):
                px, py = dx + p * step_x, dy + p * step_y
                square = px * px + py * py
                h = height[first + p]
                if square < 0.0625 * square_r:
                    n_floor += 1.0
                    h_floor += h
                elif 0.81 * square_r < square < 1.21 * square_r:
                    n_rim += 1.0
                    h_rim += h
                s0 += 1.0
                sx += px
                sy += py
                sxx += px * px
                sxy += px * py
                syy += py * py
                sh += h
                sxh += px * h
                syh += py * h
        if s0 < 3:
            continue
        cxx, cxy, cyy = sxx - sx * sx / s0, sxy - sx * sy / s0, syy - sy * sy / s0
        cxh, cyh = sxh - sx * sh / s0, syh - sy * sh / s0
        determinant = cxx * cyy - cxy * cxy
        slope_x = slope_y = 0.0
        # A few nearly collinear vertices do not determine the slope across them: the plane would become a spike.
        if s0 >= 6 and determinant > 0.05 * cxx * cyy:
            slope_x = (cxh * cyy - cyh * cxy) / determinant
            slope_y = (cyh * cxx - cxh * cxy) / determinant
        level = (sh - slope_x * sx - slope_y * sy) / s0
        if n_rim > 0 and n_floor > 0:
            # Height of the remaining older ground at rim and centre, above the plane that replaced the rest.
            rim_share, floor_share = 1 - gone[int(per_radius)], 1 - gone[0]
            sag[k] = max((h_rim / n_rim - level) * rim_share - (h_floor / n_floor - level) * floor_share, 0.0)
        for line in range(count):
            dx, dy, step_x, step_y, first, start, stop = _chord(lines, line, x[k], y[k], reach)
            for p in range(start, stop):
                px, py = dx + p * step_x, dy + p * step_y
                distance = np.sqrt(px * px + py * py)
                if distance > 0:
                    c1, s1 = px / distance, py / distance
                else:
                    c1, s1 = 1.0, 0.0
                c2, s2 = c1 * c1 - s1 * s1, 2 * c1 * s1
                c3, s3 = c2 * c1 - s2 * s1, s2 * c1 + c2 * s1
                c4, s4 = c2 * c2 - s2 * s2, 2 * c2 * s2
                stray = outline[k, 0] * c2 + outline[k, 1] * s2 + outline[k, 2] * c3 + outline[k, 3] * s3
                stray += outline[k, 4] * c4 + outline[k, 5] * s4
                uneven = crest[k, 0] * c1 + crest[k, 1] * s1 + crest[k, 2] * c2 + crest[k, 3] * s2
                uneven += crest[k, 4] * c3 + crest[k, 5] * s3
                r = distance / (radius[k] * (1 + stray))
                position = r * per_radius
                c = int(position)
                if c >= columns - 1:
                    continue
                f = position - c
                # The rim is uneven, the floor is not.
                inner = min(r, 1.0)
                uneven *= inner * inner * (3 - 2 * inner)
                lost = gone[c] * (1 - f) + gone[c + 1] * f
                crest_here = (own_rim[c] * (1 - f) + own_rim[c + 1] * f) * (1 + uneven)
                here = first + p
                old = height[here]
                plane = level + slope_x * px + slope_y * py
                height[here] = old + lost * (plane - old) + crest_here + own_bowl[c] * (1 - f) + own_bowl[c + 1] * f
                if lost > 1e-3:
                    log_left[here] += np.log1p(-0.999999 * lost)
                if brightness[k] > 0:
                    fade = 1.0 if r < 1 else np.exp(-(r - 1) / 0.5) * (1 - r / REACH)
                    albedo[here] += brightness[k] * fade
        for p in range(_N_RIM):
            angle = 2 * np.pi * p / _N_RIM
            vertex = _nearest(
                x[k] + label_radius[k] * np.cos(angle), y[k] + label_radius[k] * np.sin(angle), n_half, half_widths
            )
            rim_vertex[k, p] = vertex
            if vertex >= 0:
                rim_before[k, p] = log_left[vertex]
    rim_left = np.ones(len(x))
    for k in range(len(x)):
        total = on_grid = 0.0
        for p in range(_N_RIM):
            if rim_vertex[k, p] >= 0:
                on_grid += 1.0
                total += np.exp(log_left[rim_vertex[k, p]] - rim_before[k, p])
        if on_grid > 0:
            rim_left[k] = total / on_grid
    return sag, rim_left
