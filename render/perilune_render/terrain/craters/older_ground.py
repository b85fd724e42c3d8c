"""The older ground under a crater: a fitted plane, and the height difference from rim to centre.

The functions are compiled by numba.
"""

from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.craters.profile import REACH
from perilune_shared.geometry.frames import Array

_PLANE_REACH = 1.3
"""Radius of the circle within which the plane is fitted, in radii of the fresh crater."""


class Window(NamedTuple):
    """The vertices around a crater."""

    lines: Array
    """Lines of vertices in the format of `perilune_render.terrain.grid.lines_in` (at least `n_lines`, 7)."""
    n_lines: int
    """Number of lines in use."""


class _Plane(NamedTuple):
    """A plane through the ground around a crater."""

    level: float
    """Height at the crater's centre, metres."""
    slope_x: float
    """Slope along x."""
    slope_y: float
    """Slope along y."""
    rim: float
    """Mean height of the ground near the crater's rim above `level`, metres."""
    floor: float
    """Mean height of the ground near the crater's centre above `level`, metres."""


@njit(inline="always")
def _fit_plane(height, x, y, radius, window):
    """Fit a least-squares plane to the ground around (x, y).

    Returns whether there are enough vertices for a plane, and the plane.
    """
    s0 = sx = sy = sxx = sxy = syy = sh = sxh = syh = 0.0
    n_rim = n_floor = h_rim = h_floor = 0.0
    square_r = radius**2
    for line in range(window.n_lines):
        dx, dy, step_x, step_y, first, start, stop = _chord(window.lines, line, x, y, _PLANE_REACH * radius)
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
        return False, _Plane(0.0, 0.0, 0.0, 0.0, 0.0)
    cxx, cxy, cyy = sxx - sx * sx / s0, sxy - sx * sy / s0, syy - sy * sy / s0
    cxh, cyh = sxh - sx * sh / s0, syh - sy * sh / s0
    determinant = cxx * cyy - cxy * cxy
    slope_x = slope_y = 0.0
    # A few nearly collinear vertices do not determine the slope across their line, and the plane could become extremely
    # steep.
    if s0 >= 6 and determinant > 0.05 * cxx * cyy:
        slope_x = (cxh * cyy - cyh * cxy) / determinant
        slope_y = (cyh * cxx - cxh * cxy) / determinant
    level = (sh - slope_x * sx - slope_y * sy) / s0
    both = n_rim > 0 and n_floor > 0
    rim, floor = (h_rim / n_rim - level, h_floor / n_floor - level) if both else (0.0, 0.0)
    return True, _Plane(level, slope_x, slope_y, rim, floor)


@njit(inline="always")
def _sag(plane, removed):
    """Height difference from rim to centre, at least 0, of the older ground that remains under a crater."""
    rim_column = int((len(removed) - 1) / REACH)
    return max(plane.rim * (1 - removed[rim_column]) - plane.floor * (1 - removed[0]), 0.0)


@njit()
def _chord(lines, line, x, y, reach):
    """The part of a line within `reach` of (x, y).

    Returns the line's start relative to (x, y), the line's steps in x and y, the index of its first vertex, and the
    range of positions on the line (start, stop).
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
