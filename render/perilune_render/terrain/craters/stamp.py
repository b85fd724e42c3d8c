"""Stamp craters on the ground, oldest first, each in its own window (compiled by numba)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.craters.older_ground import Window, _chord, _fit_plane, _sag
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.profile import REACH, crest_radius, profile_tables, wear_row
from perilune_render.terrain.grid import Grid, lines_in, place_in_ring, vertex_of_ring
from perilune_shared.geometry.frames import Array

_N_RIM = 16
"""Number of points at which a rim's survival is sampled."""


@dataclass(frozen=True, slots=True)
class Stamped:
    """Results of stamping N craters."""

    sag_m: Array
    """Height difference from rim to centre of the older ground that remains under each crater, metres (N,). It does not
    include the depth of the crater."""
    rim_left: Array
    """Share of each crater's rim that younger craters have not removed (N,)."""


class _Ground(NamedTuple):
    """Fields on the vertices, modified in place."""

    height: Array
    """Heights, metres (n_vertices,)."""
    albedo: Array
    """Factor on the reflectance (n_vertices,)."""
    log_left: Array
    """Logarithm of the share of the initial ground that is left (n_vertices,). The change since a rim was stamped gives
    the share of the rim that is lost."""
    n_half: int
    """`Grid.n_half`."""
    half_widths: Array
    """`Grid.half_widths_m`."""


class _Shapes(NamedTuple):
    """Crater data for the compiled functions, oldest first."""

    x: Array
    """x of the centres, O_L, metres (N,)."""
    y: Array
    """y of the centres, O_L, metres (N,)."""
    radius: Array
    """Radii of the fresh crests, which scale the profile, metres (N,)."""
    label_radius: Array
    """Radii of the current crests, metres (N,)."""
    depth: Array
    """Fresh depths, metres (N,)."""
    rim_height: Array
    """Fresh rim heights, metres (N,)."""
    wear_row: Array
    """Fractional rows in the profile tables (N,)."""
    flat_floor: np.ndarray
    """Whether the crater has a flat floor (N,)."""
    outline: Array
    """`Craters.outline` (N, 6)."""
    crest: Array
    """`Craters.crest` (N, 6)."""
    brightness: Array
    """Relative brightening within the rim (N,)."""


class _Tables(NamedTuple):
    """`ProfileTables`, with both bowls in one array."""

    rim: Array
    """`ProfileTables.rim` (N_WEAR, n_x)."""
    bowls: Array
    """`ProfileTables.bowl` and `.flat_bowl` (2, N_WEAR, n_x)."""
    removed: Array
    """`ProfileTables.removed` (N_WEAR, n_x)."""


class _Profile(NamedTuple):
    """The profile of one crater over distance, 0 to REACH."""

    rim: Array
    """Height of rim and ejecta, metres (n_x,)."""
    bowl: Array
    """Height of the bowl, metres (n_x,)."""
    removed: Array
    """Share of the older ground that is removed (n_x,)."""


class _RimSamples(NamedTuple):
    """Points at which the survival of rims is sampled: _N_RIM for each of N craters."""

    cos: Array
    """Cosines of the points' directions from the crater's centre (_N_RIM,)."""
    sin: Array
    """Sines of the points' directions (_N_RIM,)."""
    vertex: np.ndarray
    """Index of the vertex nearest to each point, -1 outside the grid (N, _N_RIM)."""
    before: Array
    """`_Ground.log_left` at this vertex when the rim was new (N, _N_RIM)."""


def stamp_craters(
    height_m: Array, albedo: Array, grid: Grid, craters: Craters, brightness: Array, profile: str = "fassett_thomson"
) -> Stamped:
    """Stamp `craters` on height_m (n_vertices,) and brighten albedo (n_vertices,), both in place.

    A crater first replaces the ground below it by a fitted plane and then adds its profile. The more worn a crater is,
    the less of the older ground it replaces. `brightness` (N,) is the relative brightening within the rim.
    """
    ground = _Ground(height_m, albedo, np.zeros(len(height_m)), grid.n_half, grid.half_widths_m)
    return Stamped(*_stamp(ground, *_shapes_and_tables(craters, brightness, profile)))


def _shapes_and_tables(craters: Craters, brightness: Array, profile: str) -> tuple[_Shapes, _Tables]:
    """Craters and profiles as arguments of the compiled functions; see `stamp_craters`."""
    tables = profile_tables(profile)
    wear = craters.wear_m2 / (craters.diameter_m / 2) ** 2
    # The label marks the current crest, but the profile is scaled by the radius of the fresh crest.
    grown = crest_radius(wear, craters.fresh_depth_m / craters.rim_height_m, profile)
    shapes = _Shapes(
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
    )
    return shapes, _Tables(tables.rim, np.stack([tables.bowl, tables.flat_bowl]), tables.removed)


@njit()
def _stamp(ground, shapes, tables):
    """Stamp all craters; returns `Stamped.sag_m` and `Stamped.rim_left`."""
    n, columns = len(shapes.x), tables.rim.shape[1]
    profile = _Profile(np.empty(columns), np.empty(columns), np.empty(columns))
    lines = np.empty((2 * ground.n_half + 1 + 4 * len(ground.half_widths), 7))
    sag = np.zeros(n)
    angle = 2 * np.pi * np.arange(_N_RIM) / _N_RIM
    rims = _RimSamples(np.cos(angle), np.sin(angle), np.full((n, _N_RIM), -1), np.zeros((n, _N_RIM)))
    for k in range(n):
        _interpolate_profile(shapes, k, tables, profile)
        x, y, reach = shapes.x[k], shapes.y[k], REACH * shapes.radius[k]
        bounds = x - reach, x + reach, y - reach, y + reach
        window = Window(lines, lines_in(bounds, ground.n_half, ground.half_widths, lines))
        fits, plane = _fit_plane(ground.height, x, y, shapes.radius[k], window)
        if not fits:
            continue
        sag[k] = _sag(plane, profile.removed)
        _stamp_one(ground, shapes, k, profile, plane, window)
        _sample_rim(ground, shapes, k, rims)
    return sag, _rims_left(ground.log_left, rims)


@njit(inline="always")
def _interpolate_profile(shapes, k, tables, profile):
    """Interpolate the profile of crater `k` between two rows of the tables, into `profile`."""
    depth, rim_height = shapes.depth[k], shapes.rim_height[k]
    upper = min(int(shapes.wear_row[k]), tables.rim.shape[0] - 2)
    share = shapes.wear_row[k] - upper
    rim, removed = tables.rim, tables.removed
    bowl = tables.bowls[1] if shapes.flat_floor[k] else tables.bowls[0]
    for c in range(rim.shape[1]):
        profile.rim[c] = rim_height * (rim[upper, c] * (1 - share) + rim[upper + 1, c] * share)
        profile.bowl[c] = depth * (bowl[upper, c] * (1 - share) + bowl[upper + 1, c] * share)
        profile.removed[c] = removed[upper, c] * (1 - share) + removed[upper + 1, c] * share


@njit(inline="always")
def _stamp_one(ground, shapes, k, profile, plane, window):
    """Stamp crater `k` on its window of the ground."""
    x, y, radius, brightness = shapes.x[k], shapes.y[k], shapes.radius[k], shapes.brightness[k]
    outline, crest = shapes.outline[k], shapes.crest[k]
    height, albedo, log_left = ground.height, ground.albedo, ground.log_left
    own_rim, own_bowl, removed = profile
    columns = len(own_rim)
    per_radius = (columns - 1) / REACH
    for line in range(window.n_lines):
        dx, dy, step_x, step_y, first, start, stop = _chord(window.lines, line, x, y, REACH * radius)
        for p in range(start, stop):
            px, py = dx + p * step_x, dy + p * step_y
            distance = np.sqrt(px * px + py * py)
            stretch, unevenness = _irregularity(px, py, distance, outline, crest)
            r = distance / (radius * (1 + stretch))
            position = r * per_radius
            c = int(position)
            if c >= columns - 1:
                continue
            f = position - c
            # Only the rim is uneven: the unevenness fades towards the centre.
            inner = min(r, 1.0)
            unevenness *= inner * inner * (3 - 2 * inner)
            lost = removed[c] * (1 - f) + removed[c + 1] * f
            crest_here = (own_rim[c] * (1 - f) + own_rim[c + 1] * f) * (1 + unevenness)
            here = first + p
            old = height[here]
            level = plane.level + plane.slope_x * px + plane.slope_y * py
            height[here] = old + lost * (level - old) + crest_here + own_bowl[c] * (1 - f) + own_bowl[c + 1] * f
            if lost > 1e-3:
                log_left[here] += np.log1p(-0.999999 * lost)
            if brightness > 0:
                fade = 1.0 if r < 1 else np.exp(-(r - 1) / 0.5) * (1 - r / REACH)
                albedo[here] += brightness * fade


@njit(inline="always")
def _irregularity(px, py, distance, outline, crest):
    """Relative deviations of the rim's radius and of its height at (px, py) from the centre."""
    if distance > 0:
        c1, s1 = px / distance, py / distance
    else:
        c1, s1 = 1.0, 0.0
    c2, s2 = c1 * c1 - s1 * s1, 2 * c1 * s1
    c3, s3 = c2 * c1 - s2 * s1, s2 * c1 + c2 * s1
    c4, s4 = c2 * c2 - s2 * s2, 2 * c2 * s2
    radius = outline[0] * c2 + outline[1] * s2 + outline[2] * c3 + outline[3] * s3
    radius += outline[4] * c4 + outline[5] * s4
    height = crest[0] * c1 + crest[1] * s1 + crest[2] * c2 + crest[3] * s2
    height += crest[4] * c3 + crest[5] * s3
    return radius, height


@njit(inline="always")
def _sample_rim(ground, shapes, k, rims):
    """Write the samples of the new rim of crater `k` into `rims`."""
    x, y, radius = shapes.x[k], shapes.y[k], shapes.label_radius[k]
    for p in range(_N_RIM):
        vertex = _nearest(x + radius * rims.cos[p], y + radius * rims.sin[p], ground.n_half, ground.half_widths)
        rims.vertex[k, p] = vertex
        if vertex >= 0:
            rims.before[k, p] = ground.log_left[vertex]


@njit()
def _rims_left(log_left, rims):
    """Compute `Stamped.rim_left` from the sampled rims; 1 for a rim outside the grid."""
    rim_left = np.ones(len(rims.vertex))
    for k in range(len(rims.vertex)):
        total = on_grid = 0.0
        for p in range(_N_RIM):
            if rims.vertex[k, p] >= 0:
                on_grid += 1.0
                total += np.exp(log_left[rims.vertex[k, p]] - rims.before[k, p])
        if on_grid > 0:
            rim_left[k] = total / on_grid
    return rim_left


@njit()
def _nearest(x, y, n_half, half_widths):
    """Index of a vertex near (x, y), or -1 outside the grid."""
    n = n_half
    distance = max(abs(x), abs(y))
    if distance > half_widths[-1]:
        return -1
    if distance <= half_widths[0]:
        step = half_widths[0] / n
        return (int(np.rint(y / step)) + n) * (2 * n + 1) + int(np.rint(x / step)) + n
    return vertex_of_ring(np.searchsorted(half_widths, distance), int(np.rint(place_in_ring(x, y, n))), n)
