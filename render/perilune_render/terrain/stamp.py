"""Laying craters on the height field, each in its own window, strictly in order (compiled by numba)."""

import numba
import numpy as np
from scipy.spatial import KDTree

from perilune_render.terrain.craters import Craters
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.profile import LEAST_WEAR, MOST_WEAR, N_WEAR, REACH, profile_tables
from perilune_shared.frames import Array


def stamp_craters(height_m: Array, albedo: Array, grid: Grid, craters: Craters, brightness: Array) -> Array:
    """Lay `craters` on height_m (n, n; rows are y) and brighten albedo (n, n), both in place.

    A crater first replaces what it overlies by the plane through it (as far as its wear has left that removal
    visible), then adds its own profile. `brightness` (N,) is the relative brightening at the rim.

    Returns the sag (N,) in metres: by how much the older ground that shows through each crater was already lower at the
    crater's centre than at its rim, which is no depth of its own.
    """
    tables = profile_tables()
    radius = craters.diameter_m / 2
    wear = np.clip(craters.wear_m2 / radius**2, LEAST_WEAR, MOST_WEAR)
    row = np.log(wear / LEAST_WEAR) / np.log(MOST_WEAR / LEAST_WEAR) * (N_WEAR - 1)
    low = np.searchsorted(grid.coordinates_m, np.stack([craters.x_m, craters.y_m]) - REACH * radius)
    high = np.searchsorted(grid.coordinates_m, np.stack([craters.x_m, craters.y_m]) + REACH * radius)
    return _stamp(
        height_m,
        albedo,
        grid.coordinates_m,
        craters.x_m,
        craters.y_m,
        radius,
        craters.fresh_depth_m / craters.diameter_m,
        row,
        brightness,
        low[0],
        high[0],
        low[1],
        high[1],
        tables.rim,
        tables.bowl,
        tables.removed,
    )


def rim_left(craters: Craters) -> Array:
    """Share (N,) of each crater's rim that no younger crater has removed, from 16 points of the rim."""
    n_rim = 16
    angle = 2 * np.pi * np.arange(n_rim) / n_rim
    rim_x = craters.x_m[:, None] + craters.diameter_m[:, None] / 2 * np.cos(angle)
    rim_y = craters.y_m[:, None] + craters.diameter_m[:, None] / 2 * np.sin(angle)
    points = np.stack([rim_x.ravel(), rim_y.ravel()], axis=1)
    radius = craters.diameter_m / 2
    wear = np.clip(craters.wear_m2 / radius**2, LEAST_WEAR, MOST_WEAR)
    grid = np.geomspace(LEAST_WEAR, MOST_WEAR, N_WEAR)
    gone_inside = np.interp(np.log(wear), np.log(grid), profile_tables().removed[:, : int(100 * 0.9)].mean(axis=1))
    covered = KDTree(points).query_ball_point(np.stack([craters.x_m, craters.y_m], axis=1), radius)
    left = np.ones(len(points))
    for k, found in enumerate(covered):
        older = np.asarray(found, np.int64)
        older = older[older < k * n_rim]
        left[older] *= 1 - gone_inside[k]
    return left.reshape(-1, n_rim).mean(axis=1)


@numba.njit(cache=True)
def _stamp(
    height,
    albedo,
    coordinates,
    x,
    y,
    radius,
    ratio,
    wear_row,
    brightness,
    x_low,
    x_high,
    y_low,
    y_high,
    rim,
    bowl,
    removed,
):
    columns = rim.shape[1]
    per_radius = (columns - 1) / REACH
    profile = np.empty(columns)
    gone = np.empty(columns)
    sag = np.zeros(len(x))
    for k in range(len(x)):
        upper = min(int(wear_row[k]), rim.shape[0] - 2)
        share = wear_row[k] - upper
        for c in range(columns):
            rim_c = rim[upper, c] * (1 - share) + rim[upper + 1, c] * share
            bowl_c = bowl[upper, c] * (1 - share) + bowl[upper + 1, c] * share
            profile[c] = 2 * radius[k] * (rim_c + ratio[k] * bowl_c)
            gone[c] = removed[upper, c] * (1 - share) + removed[upper + 1, c] * share
        # The plane through the ground within 1.3 radii: least squares about the crater's centre.
        s0 = sx = sy = sxx = sxy = syy = sh = sxh = syh = 0.0
        n_rim = n_floor = h_rim = h_floor = 0.0
        limit = (1.3 * radius[k]) ** 2
        for j in range(y_low[k], y_high[k]):
            dy = coordinates[j] - y[k]
            for i in range(x_low[k], x_high[k]):
                dx = coordinates[i] - x[k]
                square = dx * dx + dy * dy
                if square <= limit:
                    h = height[j, i]
                    if square < 0.0625 * radius[k] ** 2:
                        n_floor += 1.0
                        h_floor += h
                    elif 0.81 * radius[k] ** 2 < square < 1.21 * radius[k] ** 2:
                        n_rim += 1.0
                        h_rim += h
                    s0 += 1.0
                    sx += dx
                    sy += dy
                    sxx += dx * dx
                    sxy += dx * dy
                    syy += dy * dy
                    sh += h
                    sxh += dx * h
                    syh += dy * h
        if s0 < 6:
            continue
        cxx, cxy, cyy = sxx - sx * sx / s0, sxy - sx * sy / s0, syy - sy * sy / s0
        cxh, cyh = sxh - sx * sh / s0, syh - sy * sh / s0
        determinant = cxx * cyy - cxy * cxy
        if determinant <= 1e-12 * cxx * cyy:
            continue
        slope_x = (cxh * cyy - cyh * cxy) / determinant
        slope_y = (cyh * cxx - cxh * cxy) / determinant
        level = (sh - slope_x * sx - slope_y * sy) / s0
        if n_rim > 0 and n_floor > 0:
            sag[k] = max(h_rim / n_rim - h_floor / n_floor, 0.0) * (1 - gone[0])
        reach = (REACH * radius[k]) ** 2
        for j in range(y_low[k], y_high[k]):
            dy = coordinates[j] - y[k]
            for i in range(x_low[k], x_high[k]):
                dx = coordinates[i] - x[k]
                square = dx * dx + dy * dy
                if square >= reach:
                    continue
                r = np.sqrt(square) / radius[k]
                position = r * per_radius
                c = int(position)
                f = position - c
                plane = level + slope_x * dx + slope_y * dy
                lost = gone[c] * (1 - f) + gone[c + 1] * f
                height[j, i] += lost * (plane - height[j, i]) + profile[c] * (1 - f) + profile[c + 1] * f
                if brightness[k] > 0:
                    fade = 1.0 if r < 1 else np.exp(-(r - 1) / 0.5) * (1 - r / REACH)
                    albedo[j, i] += brightness[k] * fade
    return sag
