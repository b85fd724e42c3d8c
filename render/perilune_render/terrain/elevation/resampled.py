"""Resample an elevation model whose site is near a pole or a cut of its map projection.

Near a pole or a cut, neighbouring points on the ground are in distant columns of the raster.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from perilune_render.terrain.elevation.site import RasterMap, Site
from perilune_render.terrain.elevation.window import places_of, repeat_px
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array

_MAX_SIDE_PX = 4096
_MARGIN_PX = 16
"""Margin around the ground, pixels, in addition to _MARGIN_FACTOR."""
_MARGIN_FACTOR = 1.25
_PAD_PX = 16
"""Rows and columns added on each side of a raster; values farther out change a spline by less than 1e-9."""
_ROWS_AT_ONCE = 64


def resampled(
    height_m: Array, known: np.ndarray, raster: RasterMap, site: Site, pixel_m: float, ground_m: float
) -> tuple[Array, np.ndarray, RasterMap]:
    """Heights (N, N) around the site, whether they are known (N, N), and their map.

    The map is azimuthal equidistant about the site, with north up. `height_m` and `known` (rows, columns) are the
    pixels of `raster`. The new pixels are `pixel_m` wide, or wider if a side would need more than _MAX_SIDE_PX of them.
    They cover a square of ground of side `ground_m` with a margin.
    """
    import rasterio

    half = ground_m / 2 * _MARGIN_FACTOR + _MARGIN_PX * pixel_m
    n = min(2 * int(np.ceil(half / pixel_m)), _MAX_SIDE_PX)
    pixel = 2 * half / n
    centre = (np.arange(n) + 0.5 - n / 2) * pixel
    padded = ndimage.spline_filter(_padded(height_m, raster), order=3, mode="nearest")
    rows, columns = height_m.shape
    heights, seen = np.empty((n, n)), np.zeros((n, n), bool)
    around = raster.circle_px
    for top in range(0, n, _ROWS_AT_ONCE):
        part = slice(top, top + _ROWS_AT_ONCE)
        # O_L's x points west and y south.
        column, row = places_of(raster, site, *np.meshgrid(-centre, centre[part]))
        on_map = np.isfinite(column) & np.isfinite(row)
        column, row = np.where(on_map, column, -1e6), np.where(on_map, row, -1e6)
        if around is not None:
            column = np.where(column < 0, column + around, np.where(column > columns, column - around, column))
        at = [row - 0.5 + _PAD_PX, column - 0.5 + _PAD_PX]
        heights[part] = ndimage.map_coordinates(padded, at, order=3, mode="nearest", prefilter=False)
        i, j = np.floor(row).astype(int), np.floor(column).astype(int)
        inside = on_map & (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        seen[part] = inside & known[np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)]
    origin = f"+lat_0={site.latitude_deg!r} +lon_0={site.longitude_deg!r}"
    crs = rasterio.crs.CRS.from_string(f"+proj=aeqd {origin} +R={MOON_RADIUS_M:.0f} +units=m +no_defs")
    transform = rasterio.Affine(pixel, 0, -n / 2 * pixel, 0, -pixel, n / 2 * pixel)
    return heights, seen, RasterMap(transform, crs, (n, n))


def _padded(height_m: Array, raster: RasterMap) -> Array:
    """Heights extended by _PAD_PX on each side.

    Columns repeat if the map shows all longitudes; rows then continue across the poles.
    """
    around, columns = repeat_px(raster), height_m.shape[1]
    if not around:
        return np.pad(height_m, _PAD_PX, mode="edge")
    if around <= columns:
        wide = np.pad(height_m[:, :around], ((0, 0), (_PAD_PX, _PAD_PX + columns - around)), mode="wrap")
    else:
        wide = np.pad(height_m, ((0, 0), (_PAD_PX, _PAD_PX)), mode="edge")
    over = np.roll(wide[:, _PAD_PX : _PAD_PX + around], around // 2, axis=1)
    over = np.pad(over, ((0, 0), (_PAD_PX, wide.shape[1] - over.shape[1] - _PAD_PX)), mode="wrap")
    ends = []
    for edge, at_pole in zip((0, height_m.shape[0]), _at_poles(raster), strict=True):
        near = slice(0, _PAD_PX) if edge == 0 else slice(edge - _PAD_PX, edge)
        ends.append(
            over[near][::-1] if at_pole else np.repeat(wide[[min(edge, edge - 1 if edge else 0)]], _PAD_PX, axis=0)
        )
    return np.concatenate([ends[0], wide, ends[1]])


def _at_poles(raster: RasterMap) -> tuple[bool, bool]:
    """Whether the upper and the lower edge of a raster lie at a pole, to within half a pixel."""
    rows, columns = raster.shape
    latitude, _ = raster.selenographic([columns / 2] * 4, [0.5, 1.5, rows - 0.5, rows - 1.5])
    first, second, last, before = np.abs(latitude)
    top, bottom = abs(second - first) / 2, abs(before - last) / 2
    return bool(abs(first + top - 90) < top), bool(abs(last + bottom - 90) < bottom)
