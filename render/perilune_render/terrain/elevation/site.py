"""The map of an elevation model, and the landing site in it: the middle, or a chosen position.

Raster coordinates are column and row, 0 at the raster's top left corner; the first pixel's centre is at 0.5, 0.5.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from perilune_render.config.terrain import ElevationConfig
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array
from perilune_shared.storage.rasters import refuse_grids

if TYPE_CHECKING:
    import rasterio

_MOON = f"+proj=longlat +R={MOON_RADIUS_M:.0f} +no_defs"
_ELEVATION = "dataset.terrain.elevation"
_FIELD = f"{_ELEVATION}.site"


@dataclass(frozen=True, slots=True)
class RasterMap:
    """The map of a raster: how its columns and rows correspond to positions on the Moon."""

    transform: rasterio.Affine
    """Projected coordinates from (column, row)."""
    crs: rasterio.crs.CRS
    """Coordinate reference system."""
    shape: tuple[int, int]
    """Numbers of rows and columns."""
    circle: float | None = None
    """Width of 360 degrees of longitude in projected coordinates; None if the map does not repeat along its rows
    (`circle_of`)."""

    @property
    def middle(self) -> tuple[float, float]:
        """Column and row of the middle of the raster."""
        return self.shape[1] / 2, self.shape[0] / 2

    def selenographic(self, column: ArrayLike, row: ArrayLike) -> tuple[Array, Array]:
        """Latitude and longitude, degrees, of raster coordinates (N,)."""
        import rasterio.warp

        east, north = self.transform @ (np.asarray(column, np.float64), np.asarray(row, np.float64))
        longitude, latitude = rasterio.warp.transform(self.crs, _MOON, east, north)
        return np.array(latitude), np.array(longitude)

    def places(self, latitude_deg: Array, longitude_deg: Array) -> tuple[Array, Array]:
        """Raster coordinates (N,) of latitudes and longitudes (N,), degrees."""
        import rasterio.warp

        east, north = (np.array(v) for v in rasterio.warp.transform(_MOON, self.crs, longitude_deg, latitude_deg))
        if self.circle is not None:
            # A raster may count longitudes from 0 or from -180, and may extend across either limit.
            middle = (self.transform @ self.middle)[0]
            east += self.circle * np.round((middle - east) / self.circle)
        column, row = ~self.transform @ (east, north)
        return column, row

    @property
    def circle_px(self) -> float | None:
        """Number of columns in 360 degrees of longitude; None if the map does not repeat along its rows."""
        turned = self.transform.b != 0 or self.transform.d != 0
        return None if self.circle is None or turned else self.circle / abs(self.transform.a)

    def part(self, top: int, left: int, shape: tuple[int, int], step: int = 1) -> RasterMap:
        """The map of a part of this raster, whose first pixel is at row `top` and column `left`.

        Each pixel of the part covers step x step pixels of this raster.
        """
        import rasterio

        transform = rasterio.Affine.translation(left, top) @ rasterio.Affine.scale(step)
        return RasterMap(self.transform @ transform, self.crs, shape, self.circle)

    def covers(self, column: float, row: float) -> bool:
        """Whether raster coordinates are in the raster; False for NaN."""
        return 0 <= column <= self.shape[1] and 0 <= row <= self.shape[0]


@dataclass(frozen=True, slots=True)
class Site:
    """The landing site in a raster."""

    column: float
    """Column."""
    row: float
    """Row."""
    latitude_deg: float
    """Latitude, degrees."""
    longitude_deg: float
    """Longitude, degrees, -180 to 180."""


def map_of(path: Path, file: Any, config: ElevationConfig) -> RasterMap:
    """The map of an open raster. Raises UserError if it has no pixel size or is not a map of the Moon."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    transform, crs = file.transform, file.crs
    if config.crs is not None:
        try:
            crs = CRS.from_user_input(config.crs)
        except CRSError as error:
            expected = "a coordinate reference system of the Moon: IAU_2015:30135, +proj=..., or WKT"
            raise UserError("configuration", f"{_ELEVATION}.crs", error, expected) from None
        refuse_grids(path, crs)
    if transform.is_identity or transform.determinant == 0 or not np.isfinite(tuple(transform)).all():
        raise UserError(path, "pixel size", "none", "a geotransform with the pixel's size")
    if crs is None:
        beside = path.with_name(f"{path.name}.aux.xml")
        hint = f" ({beside.name} is not read: gdal_translate can join it to the file)" if beside.is_file() else ""
        expected = f"a coordinate reference system of the Moon in the file{hint}, or {_ELEVATION}.crs"
        raise UserError(path, "projection", "none", expected)
    _refuse_other_bodies(path, crs)
    return RasterMap(transform, crs, (file.height, file.width), circle_of(crs))


def _refuse_other_bodies(path: Path, crs: rasterio.crs.CRS) -> None:
    """Raise UserError unless a coordinate system's ellipsoid has the Moon's radius, within one percent.

    PROJ refuses to transform between bodies, but its error message names neither body.
    """
    ellipsoid = re.search(r'(?:SPHEROID|ELLIPSOID)\["([^"]*)",\s*([0-9.eE+]+)', crs.to_wkt())
    radius = float(ellipsoid[2]) if ellipsoid else 0.0
    if abs(radius / MOON_RADIUS_M - 1) > 0.01:
        name = f"{ellipsoid[1]}, radius {radius / 1000:.0f} km" if ellipsoid else "a system without sphere or ellipsoid"
        raise UserError(
            path, "projection", name, f"a coordinate reference system of the Moon ({MOON_RADIUS_M / 1000:.0f} km)"
        )


def circle_of(crs: rasterio.crs.CRS) -> float | None:
    """Width of 360 degrees in a system's coordinates.

    Returns None unless meridians are vertical lines at even distances.
    """
    import rasterio.warp

    if crs.is_geographic:
        return 360.0
    longitude, latitude = (each.ravel() for each in np.meshgrid(np.arange(-180.0, 180.0, 10.0), [-40.0, 0.0, 40.0]))
    x, y = (np.reshape(v, (3, 36)) for v in rasterio.warp.transform(_MOON, crs, longitude, latitude))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return None
    steps = np.diff(x, axis=1)
    circle = 36 * float(np.median(steps))
    tolerance = 1e-6 * abs(circle)
    # One step may jump from one edge of the map to the other.
    jumps = np.abs(steps - circle / 36) > tolerance
    even = (jumps.sum(axis=1) <= 1).all() and np.allclose(x, x[0], rtol=0, atol=tolerance)
    return abs(circle) if circle and even and np.allclose(y, y[:, :1], rtol=0, atol=tolerance) else None


def site_in(path: Path, raster: RasterMap, config: ElevationConfig) -> Site:
    """The site that a configuration states, or the middle of the raster.

    Raises UserError if a stated site is outside the raster, or if the raster's map is not a map of the Moon.
    """
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    pixel, degrees = config.site_px, config.site_deg
    try:
        if degrees is not None:
            latitude, longitude = degrees[0], degrees[1] - 360 if degrees[1] > 180 else degrees[1]
            column, row = _place_of(raster, latitude, longitude)
            _refuse_outside(path, raster, column, row, f"latitude {latitude:g}, longitude {longitude:g}", "deg")
        else:
            column, row = raster.middle if pixel is None else pixel
            _refuse_outside(path, raster, column, row, f"column {column:g}, row {row:g}", "px")
            latitude, longitude = (float(v[0]) for v in raster.selenographic([column], [row]))
    except (RasterioError, CPLE_BaseError) as error:
        raise UserError(path, "projection", error, "a coordinate reference system of the Moon") from None
    return Site(column, row, latitude, longitude)


def _place_of(raster: RasterMap, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """Raster coordinates of a position, NaN if the raster's projection does not extend to it."""
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    try:
        column, row = raster.places(np.array([latitude_deg]), np.array([longitude_deg]))
    except (RasterioError, CPLE_BaseError):  # rasterio does not wrap the errors of GDAL here
        return np.nan, np.nan
    return float(column[0]), float(row[0])


def _refuse_outside(path: Path, raster: RasterMap, column: float, row: float, found: str, unit: str) -> None:
    if raster.covers(column, row):
        return
    rows, columns = raster.shape
    if unit == "px":
        expected = f"column 0 to {columns}, row 0 to {rows}"
    else:
        # A lattice, not only the border: a raster around a pole has its extreme latitude inside.
        lattice = np.meshgrid(np.linspace(0, columns, 65), np.linspace(0, rows, 65))
        latitude, longitude = raster.selenographic(*(each.ravel() for each in lattice))
        middle = raster.selenographic([raster.middle[0]], [raster.middle[1]])[1][0]
        east = middle + (longitude - middle + 180) % 360 - 180
        expected = (
            f"a place in the raster: latitude {latitude.min():.6g} to {latitude.max():.6g}, "
            f"longitude {east.min():.6g} to {east.max():.6g}"
        )
    raise UserError(path, f"{_FIELD}_*_{unit}", found, expected)


def refuse_hole(path: Path, raster: RasterMap, part: RasterMap, known: np.ndarray, site: Site) -> None:
    """Raise UserError if the site has no height.

    Column and row of `site` refer to `part` of the raster. `known` (rows, columns) says which pixels of the part have a
    height.
    """
    i, j = min(int(site.row), part.shape[0] - 1), min(int(site.column), part.shape[1] - 1)
    if known[i, j]:
        return
    rows, columns = np.nonzero(known)
    k = int(np.argmin((rows - i) ** 2 + (columns - j) ** 2))
    near = _between(part, raster, float(columns[k]) + 0.5, float(rows[k]) + 0.5)
    column, row = _between(part, raster, site.column, site.row)
    latitude, longitude = raster.selenographic([near[0]], [near[1]])
    raise UserError(
        path,
        _FIELD,
        f"column {column:.1f}, row {row:.1f}, which has no height",
        f"a pixel with a height; the nearest is column {near[0]}, row {near[1]} "
        f"(latitude {latitude[0]:.6f}, longitude {longitude[0]:.6f})",
    )


def site_within(raster: RasterMap, part: RasterMap, site: Site) -> Site:
    """The site, with its column and row in a part of the raster."""
    column, row = _between(raster, part, site.column, site.row)
    return Site(column, row, site.latitude_deg, site.longitude_deg)


def _between(raster: RasterMap, other: RasterMap, column: float, row: float) -> tuple[float, float]:
    """Column and row in `other` of coordinates in `raster`; both rasters have the same projection."""
    if raster.transform == other.transform:
        return column, row
    column, row = ~other.transform @ (raster.transform @ (column, row))
    circle = other.circle_px
    if circle is not None:
        column += circle * round((other.middle[0] - column) / circle)
    return column, row
