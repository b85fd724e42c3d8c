"""Use a real elevation model as the base of a scene: any projection and pixel size, holes allowed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from perilune_render.config_terrain import ElevationConfig, Outside
from perilune_render.terrain.elevation.continuation import continued, distance_in_holes_m, margin_m, mean_slope
from perilune_render.terrain.elevation.quantisation import smoothed, step_of
from perilune_render.terrain.elevation.site import RasterMap, Site, site_in
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array, selenographic_from_site
from perilune_shared.storage.files import sha256_of

if TYPE_CHECKING:
    import rasterio

_AT_THE_MIDDLE = ElevationConfig()
_LARGEST_PIXELS = 100_000_000
_RESOLVED_PIXELS = 4.0
"""Diameter from which a model shows a crater, pixels."""
_SWELL_M = 120.0
"""Standard deviation of the low-pass filter for a mirrored model, metres; long waves exceed about 4 times this."""
_SEAM_M = 100.0
"""Width of the band along a mirrored model's edge in which short waves are point-reflected too, metres."""


@dataclass(frozen=True, slots=True)
class ElevationModel:
    """An elevation model in memory."""

    height_m: Array
    """Heights (rows, columns) from the raster's top, metres, with holes filled."""
    known: np.ndarray
    """Whether a pixel has a height in the raster (rows, columns)."""
    raster: RasterMap
    """Where the raster's columns and rows are on the Moon."""
    latitude_deg: float
    """Latitude of the site, degrees."""
    longitude_deg: float
    """Longitude of the site, degrees."""
    pixel_m: float
    """Ground size of a pixel at the site, the mean of both directions, metres."""
    pixel_sides_m: tuple[float, float]
    """Ground size of a pixel from row to row and from column to column, metres."""
    step_m: float
    """Quantisation step of the raster's heights if it makes terraces, metres; otherwise 0."""
    hole_m: Array | None
    """Distance of each pixel (rows, columns) from the nearest known one, metres; None without holes."""
    source: str
    """File name (without folder and special characters) and SHA-256."""


def read_elevation(path: Path, config: ElevationConfig = _AT_THE_MIDDLE) -> ElevationModel:
    """Read a GeoTIFF elevation model; its site is the one of `config`, or the raster's middle.

    Raises UserError if it is missing, unreadable, too large, empty, or has no pixel size or no projection of the Moon,
    or if the site is outside it or in a hole.
    Holes (nodata, NaN) are filled with the nearest known height. Heights may be elevations or radii: only differences
    matter, since the site is set to height 0. Quantised heights are smoothed within half a step
    (`perilune_render.terrain.elevation.quantisation`).
    """
    # Imported where it is used, since it takes a fifth of a second.
    import rasterio
    from rasterio.errors import RasterioError

    if not path.is_file():
        raise UserError(path, "dem", "no such file", "a GeoTIFF elevation model")
    try:
        with rasterio.open(path) as raster:
            if raster.width * raster.height > _LARGEST_PIXELS:
                raise UserError(path, "size", f"{raster.width} x {raster.height}", f"at most {_LARGEST_PIXELS} pixels")
            height = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            # Some products store integers with a scale and an offset.
            height = height * raster.scales[0] + raster.offsets[0]
            transform, crs = raster.transform, raster.crs
    except RasterioError as error:
        raise UserError(path, "dem", error.__cause__ or error, "a readable GeoTIFF") from None
    if transform.is_identity or transform.determinant == 0:
        raise UserError(path, "pixel size", "none", "a geotransform with the pixel's size")
    if crs is None:
        raise UserError(path, "projection", "none", "a coordinate reference system of the Moon")
    _refuse_other_bodies(path, crs)
    known = np.isfinite(height)
    if known.sum() < 16:
        raise UserError(path, "heights", f"{known.sum()} known", "an elevation model with data")
    if not known.all():
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    raster_map = RasterMap(transform, crs, height.shape)
    site = site_in(path, raster_map, known, config)
    sides = _pixel_sides_m(raster_map, site)
    hole = distance_in_holes_m(known, sides)
    step = step_of(height[known], float(np.mean(sides)))
    if step:
        height = smoothed(height, step)
    plain_name = re.sub(r"[^A-Za-z0-9._-]", "_", path.name)[-100:].lstrip("._-")
    source = f"{plain_name} sha256:{sha256_of(path)}"
    place, pixel = (site.latitude_deg, site.longitude_deg), float(np.mean(sides))
    return ElevationModel(height, known, raster_map, *place, pixel, sides, step, hole, source)


def _refuse_other_bodies(path: Path, crs: rasterio.crs.CRS) -> None:
    """Raises UserError unless the ellipsoid of a coordinate system has the Moon's radius, within one percent.

    PROJ refuses to transform between bodies, but its error message states neither body.
    """
    found = re.search(r'(?:SPHEROID|ELLIPSOID)\["([^"]*)",\s*([0-9.eE+]+)', crs.to_wkt())
    radius = float(found[2]) if found else 0.0
    if abs(radius / MOON_RADIUS_M - 1) > 0.01:
        name = f"{found[1]}, radius {radius / 1000:.0f} km" if found else "none on a sphere or ellipsoid"
        raise UserError(
            path, "projection", name, f"a coordinate reference system of the Moon ({MOON_RADIUS_M / 1000:.0f} km)"
        )


def raster_places(model: ElevationModel, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Column and row, 0 at the raster's top left corner, of places (...) of O_L's plane, metres."""
    lat, lon = selenographic_from_site(x_m, y_m, model.latitude_deg, model.longitude_deg)
    column, row = model.raster.places(np.ravel(lat), np.ravel(lon))
    return column.reshape(np.shape(x_m)), row.reshape(np.shape(x_m))


def height_of_site_m(model: ElevationModel) -> float:
    """Height of the site above the sphere of MOON_RADIUS_M in the model, metres.

    Heights of more than half this radius are taken for radii.
    """
    column, row = raster_places(model, np.zeros(1), np.zeros(1))
    height = float(ndimage.map_coordinates(model.height_m, [row - 0.5, column - 0.5], order=3, mode="nearest")[0])
    return height - MOON_RADIUS_M if height > MOON_RADIUS_M / 2 else height


def resolved_m(model: ElevationModel) -> float:
    """Diameter, metres, from which an elevation model shows a crater: four pixels. Smaller craters are generated."""
    return _RESOLVED_PIXELS * model.pixel_m


def beyond_m(model: ElevationModel, column: Array, row: Array) -> Array:
    """Distance, metres, of raster places (...) from the model's known ground: 0 on it, above 0 in holes and outside."""
    rows, columns = model.height_m.shape
    down = np.maximum(np.maximum(-row, row - rows), 0) * model.pixel_sides_m[0]
    across = np.maximum(np.maximum(-column, column - columns), 0) * model.pixel_sides_m[1]
    beyond = np.hypot(down, across)
    if model.hole_m is not None:
        beyond += ndimage.map_coordinates(model.hole_m, [row - 0.5, column - 0.5], order=1, mode="nearest")
    return beyond


def refuse_beyond(model: ElevationModel, grid: Grid, outside: Outside) -> None:
    """Raises UserError if `outside` is "refuse" and the ground extends beyond the model's raster."""
    if outside != "refuse":
        return
    edge = grid.extent_m / 2 * np.linspace(-1, 1, 33)
    x, y = np.concatenate([(edge, edge * 0 + side) for side in (edge[0], edge[-1])], axis=1)
    column, row = raster_places(model, np.append(x, y), np.append(y, x))
    rows, columns = model.height_m.shape
    if ((row < 0) | (row > rows) | (column < 0) | (column > columns)).any():
        down, across = rows * model.pixel_sides_m[0], columns * model.pixel_sides_m[1]
        raise UserError(
            model.source,
            "dataset.terrain.elevation.outside",
            f"a model of {across:.0f} m x {down:.0f} m for {grid.extent_m:.0f} m of ground around the site",
            "a larger model, a site farther from its edge, a lower flight or a narrower view, or "
            "dataset.terrain.elevation.outside=procedural",
        )


def remarks(model: ElevationModel, grid: Grid, outside: Outside) -> list[str]:
    """Messages to the user about a model, one per line, shown before its ground is generated."""
    lines = []
    name = model.source.split(" sha256:")[0]
    if model.step_m:
        lines.append(f"{name}: heights are in steps of {model.step_m:.3g} m; they are smoothed within half a step")
    net = np.linspace(-grid.extent_m / 2, grid.extent_m / 2, 129)
    share = float((beyond_m(model, *raster_places(model, *np.meshgrid(net, net))) == 0).mean())
    if share < 1:
        rest = "procedural" if outside == "procedural" else "its mirror image"
        side = f"{grid.extent_m:.0f} m"
        lines.append(f"{name}: {share:.0%} of the ground, {side} x {side}, is real, the rest {rest}")
    return lines


def base_heights(model: ElevationModel, grid: Grid, outside: Outside = "procedural") -> tuple[Array, Array]:
    """Heights (n_vertices,) of the model on the grid, and distances (n_vertices,) from known ground, both in metres.

    The site is at height 0. Heights are interpolated bicubically. Beyond the model the ground continues smoothly
    (`perilune_render.terrain.elevation.continuation`), and relief and craters are added later; with `outside` "mirror"
    it is the model's mirror image. Raises UserError if the ground extends beyond the model and `outside` is "refuse".
    """
    rows, columns = model.height_m.shape
    # Pixel coordinates vary slowly over a site: project a coarse lattice and interpolate.
    net = np.linspace(-grid.extent_m / 2, grid.extent_m / 2, 65)
    column, row = raster_places(model, *np.meshgrid(net, net))
    x, y = grid.vertices_xy()
    from scipy.interpolate import RectBivariateSpline  # here, since it takes 0.2 s and only elevation models need it

    column, row = (RectBivariateSpline(net, net, place).ev(y, x) for place in (column, row))
    beyond = beyond_m(model, column, row)
    pixels = float(np.maximum.reduce([-row, row - rows, -column, column - columns]).max())
    sides = rows * model.pixel_sides_m[0], columns * model.pixel_sides_m[1]
    refuse_beyond(model, grid, outside)
    middle = grid.n_half * (2 * grid.n_half + 2)
    if not beyond.any():
        height = ndimage.map_coordinates(model.height_m, [row - 0.5, column - 0.5], order=3, mode="nearest")
        return height - height[middle], beyond
    margin = int(np.ceil(max(pixels, 0))) + 2
    if outside == "procedural":
        margin = min(margin, int(np.ceil(margin_m(sides) / min(model.pixel_sides_m))) + 2)
    if (rows + 2 * margin) * (columns + 2 * margin) > _LARGEST_PIXELS:
        ground = f"{grid.extent_m:.0f} m of ground"
        raise UserError(
            model.source, "dem", f"{rows} x {columns} pixels for {ground}", "a model that covers more of it"
        )
    places = [row - 0.5 + margin, column - 0.5 + margin]
    if outside == "mirror":
        padded = _mirrored(model.height_m, margin, model.pixel_m)
        height = ndimage.map_coordinates(padded, places, order=3, mode="nearest")
    else:
        centres = [np.arange(n + 2 * margin) + 0.5 - margin for n in (rows, columns)]
        far = beyond_m(model, *np.meshgrid(centres[1], centres[0]))
        padded = continued(model.height_m, far, margin, model.pixel_sides_m)
        height = ndimage.map_coordinates(padded, places, order=3, mode="nearest")
        height += mean_slope(model.height_m, row - 0.5, column - 0.5, beyond, min(sides))
    return height - height[middle], beyond


def _mirrored(height_m: Array, margin: int, pixel_m: float) -> Array:
    """Heights extended by `margin` pixels on each side, without a crease at the model's edge.

    Long waves continue by point reflection, which keeps the slope across the edge. Short waves are mirrored, so that
    craters remain craters; in a narrow band along the edge they continue by point reflection too.
    """
    point_reflected = np.pad(height_m, margin, mode="reflect", reflect_type="odd")
    swell = ndimage.gaussian_filter(point_reflected, _SWELL_M / pixel_m, mode="nearest")
    inner = slice(margin, -margin)
    mirrored = np.pad(height_m - swell[inner, inner], margin, mode="reflect")
    rows, columns = (
        np.maximum(np.maximum(margin - i, i - margin - n + 1), 0)
        for i, n in zip(np.ogrid[: len(swell), : swell.shape[1]], height_m.shape, strict=True)
    )
    away = np.clip(np.maximum(rows, columns) * pixel_m / _SEAM_M, 0, 1)
    away = away * away * (3 - 2 * away)
    return swell + away * mirrored + (1 - away) * (point_reflected - swell)


def _pixel_sides_m(raster: RasterMap, site: Site) -> tuple[float, float]:
    """Ground size of a pixel at the site from row to row and from column to column, from great-circle distances.

    Approximation: small differences of latitude and longitude; wrong within two pixels of a pole.
    """
    # Inwards at the last row or column, since latitudes may end there.
    down, across = (-1 if place + 1 > n else 1 for place, n in zip((site.row, site.column), raster.shape, strict=True))
    lats, lons = raster.selenographic(
        np.array([site.column, site.column + across]), np.array([site.row + down, site.row])
    )
    to_east = np.cos(np.radians(site.latitude_deg)) * np.radians((lons - site.longitude_deg + 180) % 360 - 180)
    to_north = np.radians(lats - site.latitude_deg)
    high, wide = MOON_RADIUS_M * np.hypot(to_east, to_north)
    return float(high), float(wide)
