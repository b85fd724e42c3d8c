"""The part of a raster that a scene needs: all of a small raster, or a window of a large raster.

A window with too many pixels is read at a lower resolution. The columns of a raster of the whole Moon repeat. If the
scene's ground crosses the left or right edge, the raster is cut at another meridian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perilune_render.terrain.elevation.height_band import HeightBand
from perilune_render.terrain.elevation.site import RasterMap, Site
from perilune_shared.geometry.frames import Array, selenographic_from_site

LARGEST_PIXELS = 2**24
"""Largest number of pixels of a raster that is read whole, and of a window."""
UNSTATED_GROUND_M = 20_000.0
"""Side of the ground for which a large model is read if the caller does not state one, metres."""
_AROUND = 1.25
"""Half-width of a window divided by the ground's half-width; the margin is for terrain statistics and interpolation."""
_MIN_PX = 64
"""Smallest margin between the ground and the edge of a window of a large raster, pixels."""
_NET = 65
"""Number of points along a side of the lattice on which raster coordinates are tested for smoothness."""
_ROUGH_PX = 0.5
"""Largest error of interpolated raster coordinates, pixels; above it, the map is discontinuous or too distorted."""


@dataclass(frozen=True, slots=True)
class Window:
    """A part of a raster; each of its pixels is the mean of step x step pixels of the raster."""

    top: int
    """First row."""
    left: int
    """First column; may be below 0 or beyond the last column if the raster's columns repeat."""
    shape: tuple[int, int]
    """Numbers of rows and columns of the part."""
    step: int
    """Number of raster rows, and of raster columns, in one pixel of the part."""
    cut: bool
    """Whether the part differs from the whole raster."""


def chosen_window(raster: RasterMap, site: Site, ground_m: float | None) -> Window:
    """The part of a raster to read for square ground around a site.

    `ground_m` is the side of the ground, metres; None stands for UNSTATED_GROUND_M.
    """
    rows, columns = raster.shape
    net = np.linspace(-0.5, 0.5, 9) * (UNSTATED_GROUND_M if ground_m is None else ground_m) * _AROUND
    column, row = _places_about(raster, site, *np.meshgrid(net, net))
    around = repeat_px(raster)
    across = around and (column.min() < 4 or column.max() > columns - 4)
    if rows * columns <= LARGEST_PIXELS:
        left = round(site.column - around / 2) if across else 0
        return Window(0, left, (rows, around if across else columns), 1, bool(across))
    margin = _MIN_PX
    top, bottom = (int(np.clip(edge, 0, rows)) for edge in (row.min() - margin, row.max() + margin + 1))
    left, right = (int(edge) for edge in (np.floor(column.min() - margin), np.ceil(column.max() + margin)))
    if not across:
        left, right = max(left, 0), min(right, columns)
    elif right - left > around:
        left, right = round(site.column - around / 2), round(site.column - around / 2) + around
    step = int(np.ceil(np.sqrt(max((bottom - top) * (right - left), 1) / LARGEST_PIXELS)))
    if across:
        # No pixel of the part may include columns from both sides of the edge.
        edge = 0 if left < 0 else around
        left = edge - step * -(-(edge - left) // step)
    return Window(top, left, (max((bottom - top) // step, 1), max((right - left) // step, 1)), step, True)


def repeat_px(raster: RasterMap) -> int:
    """Number of columns after which a raster repeats; 0 if it does not show all longitudes."""
    circle, columns = raster.circle_px, raster.shape[1]
    if circle is None:
        return 0
    if abs(circle - round(circle)) < 0.05 and columns >= round(circle) - 1:
        return round(circle)
    return columns if abs(circle - columns) < 1 else 0


def read_window(band: HeightBand, raster: RasterMap, window: Window) -> Array:
    """Heights (rows, columns) of a window in the file's unit, NaN where the raster has no height."""
    from rasterio.windows import Window as Part

    rows, step = window.shape[0], window.step
    pieces = []
    for first, count in _runs(raster, window):
        if first is None:
            pieces.append(np.full((rows, count), np.nan))
        else:
            pieces.append(band.read(Part(first, window.top, count * step, rows * step), (rows, count)))
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=1)


def smooth_over(raster: RasterMap, site: Site, ground_m: float) -> bool:
    """Whether a raster's coordinates vary smoothly enough for interpolation over ground around a site.

    The ground is a square of side `ground_m`. Coordinates do not vary smoothly across a cut of the map, as at longitude
    180, or around a pole of a cylindrical map.
    """
    from scipy.interpolate import RectBivariateSpline

    net = np.linspace(-ground_m / 2, ground_m / 2, _NET)
    between = (net[1:] + net[:-1]) / 2
    known = [places_of(raster, site, *np.meshgrid(each, each)) for each in (net, between)]
    if not all(np.isfinite(coordinate).all() for pair in known for coordinate in pair):
        return False
    off = [
        np.abs(RectBivariateSpline(net, net, at).ev(*np.meshgrid(between, between, indexing="ij")) - there).max()
        for at, there in zip(*known, strict=True)
    ]
    return max(off) < _ROUGH_PX


def places_of(raster: RasterMap, site: Site, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Column and row in the raster of the positions x_m, y_m on O_L's plane; all arrays have one shape."""
    latitude, longitude = selenographic_from_site(x_m, y_m, site.latitude_deg, site.longitude_deg)
    column, row = raster.places(np.ravel(latitude), np.ravel(longitude))
    return column.reshape(np.shape(x_m)), row.reshape(np.shape(x_m))


def _places_about(raster: RasterMap, site: Site, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Columns and rows of the positions that the map can show, followed by the site's own column and row.

    If the map repeats every 360 degrees of longitude, a position has many columns; the column nearest to the site is
    returned.
    """
    column, row = places_of(raster, site, x_m, y_m)
    good = np.isfinite(column) & np.isfinite(row)
    column, row = column[good], row[good]
    circle = raster.circle_px
    if circle is not None:
        column = column + circle * np.round((site.column - column) / circle)
    return np.append(column, site.column), np.append(row, site.row)


def _runs(raster: RasterMap, window: Window) -> list[tuple[int | None, int]]:
    """Split the columns of a window into runs of consecutive columns of the raster.

    Returns the first raster column of each run, None where the raster has no columns, and the number of window columns
    in the run.
    """
    columns, step, around = raster.shape[1], window.step, repeat_px(raster)
    runs: list[tuple[int | None, int]] = []
    column, left = window.left, window.shape[1]
    while left > 0:
        first = column % around if around else column
        most = (min(columns, around) if around else columns) - first
        has = most >= step
        count = min(most // step if has else max((around - first) // step, 1), left)
        runs.append((first if has else None, count))
        column, left = column + count * step, left - count
    return runs
