"""Change of the ground if craters are omitted, without stamping all other craters again (compiled by numba).

Let D be the height without some craters minus the height with all craters. It is 0 before the oldest omitted crater. An
omitted crater subtracts its own change of the ground from D. Any other crater replaces a share of the ground by a
fitted plane and adds a profile. The fit is linear in the heights, so the crater replaces the same share of D by the
plane fitted to D, and adds no profile. D is therefore exact, and it differs from 0 only near the omitted craters.
"""

from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_render.terrain.craters.older_ground import Window, _chord, _fit_plane
from perilune_render.terrain.craters.population import Craters
from perilune_render.terrain.craters.profile import REACH
from perilune_render.terrain.craters.stamp import (
    _Ground,
    _interpolate_profile,
    _Profile,
    _shapes_and_tables,
    _stamp_one,
)
from perilune_render.terrain.grid import Grid, lines_in
from perilune_shared.geometry.frames import Array

_MARGIN = 1.1
"""Factor on the reach of a crater, for its uneven outline."""


class _Changes(NamedTuple):
    """Changes of the ground by M recorded craters."""

    slot: np.ndarray
    """Number of each crater among the recorded ones, -1 if it is not recorded (N,)."""
    first: np.ndarray
    """Index of the first change of each recorded crater, then the total (M + 1,)."""
    vertex: np.ndarray
    """Vertex of each change (n_changes,) int32."""
    height: np.ndarray
    """Change of the height, metres (n_changes,) float32."""
    albedo: np.ndarray
    """Change of the albedo factor (n_changes,) float32."""


class CraterChanges:
    """The changes of the ground by some craters of a scene, from which the ground without them is computed."""

    def __init__(
        self,
        soil: tuple[Array, Array],
        grid: Grid,
        craters: Craters,
        recorded: np.ndarray,
        brightness: Array,
        profile: str,
    ):
        """Stamp `craters` on heights and albedo, the pair `soil` of arrays (n_vertices,), in place.

        `recorded` are the indices of the craters that may be omitted later, `brightness` (N,) is the relative
        brightening within each rim.
        """
        self._grid, self._craters = grid, craters
        self._shapes, self._tables = _shapes_and_tables(craters, brightness, profile)
        ground = _Ground(*soil, np.zeros(grid.n_vertices), grid.n_half, grid.half_widths_m)
        slot = np.full(len(craters), -1)
        slot[recorded] = np.arange(len(recorded))
        counts = _counts(ground, self._shapes, slot, len(recorded))
        first = np.concatenate([[0], np.cumsum(counts)])
        n = int(first[-1])
        changes = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.float32)
        self._changes = _Changes(slot, first, *changes)
        _record(ground, self._shapes, self._tables, self._changes)
        # Heights and albedo of the difference ground; only the changed vertices are reset after each use.
        self._difference = _Ground(
            np.zeros(grid.n_vertices), np.zeros(grid.n_vertices), np.zeros(grid.n_vertices), *ground[3:]
        )

    def without(self, omitted: np.ndarray) -> tuple[Array, Array]:
        """Heights and albedo without the `omitted` craters minus those with all craters, (n_vertices,) each.

        `omitted` are indices of recorded craters. The arrays are overwritten by the next call. The change of the albedo
        does not include rays.
        """
        difference = self._difference
        difference.height[:], difference.albedo[:], difference.log_left[:] = 0, 0, 0
        is_omitted = np.zeros(len(self._craters), bool)
        is_omitted[omitted] = True
        shapes = self._shapes._replace(brightness=np.zeros(len(is_omitted)))
        _subtract(difference, shapes, self._tables, self._changes, is_omitted, self._near(omitted))
        return difference.height, difference.albedo

    def _near(self, omitted: np.ndarray) -> np.ndarray:
        """Indices, ascending, of the omitted craters and of younger craters that may change their ground."""
        x, y, reach = self._craters.x_m, self._craters.y_m, _MARGIN * REACH * self._shapes.radius
        touched = np.zeros(len(x), bool)
        for k in omitted.tolist():
            square = np.square(x[k:] - x[k]) + np.square(y[k:] - y[k])
            # Craters that overlap a changed window spread the change a little farther.
            touched[k:] |= square < np.square(reach[k:] + 2 * reach[k])
        return np.flatnonzero(touched)


@njit()
def _counts(ground, shapes, slot, n):
    """Number of vertices within the reach of each recorded crater (n,)."""
    lines = np.empty((2 * ground.n_half + 1 + 4 * len(ground.half_widths), 7))
    counts = np.zeros(n, np.int64)
    for k in range(len(slot)):
        if slot[k] >= 0:
            x, y, reach = shapes.x[k], shapes.y[k], REACH * shapes.radius[k]
            n_lines = lines_in((x - reach, x + reach, y - reach, y + reach), ground.n_half, ground.half_widths, lines)
            for line in range(n_lines):
                _, _, _, _, _, start, stop = _chord(lines, line, x, y, reach)
                counts[slot[k]] += max(stop - start, 0)
    return counts


@njit()
def _record(ground, shapes, tables, changes):
    """Stamp all craters; write the changes by the recorded ones into `changes`."""
    columns = tables.rim.shape[1]
    profile = _Profile(np.empty(columns), np.empty(columns), np.empty(columns))
    lines = np.empty((2 * ground.n_half + 1 + 4 * len(ground.half_widths), 7))
    for k in range(len(shapes.x)):
        _interpolate_profile(shapes, k, tables, profile)
        x, y, reach = shapes.x[k], shapes.y[k], REACH * shapes.radius[k]
        bounds = x - reach, x + reach, y - reach, y + reach
        window = Window(lines, lines_in(bounds, ground.n_half, ground.half_widths, lines))
        slot = changes.slot[k]
        if slot >= 0:
            at = changes.first[slot]
            for line in range(window.n_lines):
                _, _, _, _, first, start, stop = _chord(lines, line, x, y, reach)
                for p in range(start, stop):
                    changes.vertex[at] = first + p
                    changes.height[at] = -ground.height[first + p]
                    changes.albedo[at] = -ground.albedo[first + p]
                    at += 1
        fits, plane = _fit_plane(ground.height, x, y, shapes.radius[k], window)
        if fits:
            _stamp_one(ground, shapes, k, profile, plane, window)
        if slot >= 0:
            for at in range(changes.first[slot], changes.first[slot + 1]):
                changes.height[at] += ground.height[changes.vertex[at]]
                changes.albedo[at] += ground.albedo[changes.vertex[at]]


@njit()
def _subtract(difference, shapes, tables, changes, is_omitted, chosen):
    """Compute the difference ground (module docstring); `chosen` are the craters that may change it."""
    columns = tables.rim.shape[1]
    profile = _Profile(np.empty(columns), np.empty(columns), np.empty(columns))
    lines = np.empty((2 * difference.n_half + 1 + 4 * len(difference.half_widths), 7))
    for k in chosen:
        if is_omitted[k]:
            slot = changes.slot[k]
            for at in range(changes.first[slot], changes.first[slot + 1]):
                difference.height[changes.vertex[at]] -= changes.height[at]
                difference.albedo[changes.vertex[at]] -= changes.albedo[at]
            continue
        _interpolate_profile(shapes, k, tables, profile)
        profile.rim[:] = 0
        profile.bowl[:] = 0
        x, y, reach = shapes.x[k], shapes.y[k], REACH * shapes.radius[k]
        bounds = x - reach, x + reach, y - reach, y + reach
        window = Window(lines, lines_in(bounds, difference.n_half, difference.half_widths, lines))
        fits, plane = _fit_plane(difference.height, x, y, shapes.radius[k], window)
        if fits and (
            plane.level != 0 or plane.slope_x != 0 or plane.slope_y != 0 or _any(difference, x, y, reach, window)
        ):
            _stamp_one(difference, shapes, k, profile, plane, window)


@njit()
def _any(difference, x, y, reach, window):
    """Whether the difference is not 0 at any vertex within `reach` of (x, y)."""
    for line in range(window.n_lines):
        _, _, _, _, first, start, stop = _chord(window.lines, line, x, y, reach)
        for p in range(start, stop):
            if difference.height[first + p] != 0:
                return True
    return False
