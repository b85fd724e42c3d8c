"""Use a real elevation model, with any projection and pixel size, as the base of a scene.

The model may have holes.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from perilune_render.config.terrain import ElevationConfig, Outside
from perilune_render.terrain.elevation.continuation import continued, distance_in_holes_m, margin_m, mean_slope
from perilune_render.terrain.elevation.height_band import height_band
from perilune_render.terrain.elevation.quantisation import smoothed, step_of
from perilune_render.terrain.elevation.resampled import resampled
from perilune_render.terrain.elevation.site import RasterMap, Site, map_of, refuse_hole, site_in, site_within
from perilune_render.terrain.elevation.window import UNSTATED_GROUND_M, chosen_window, read_window, smooth_over
from perilune_render.terrain.grid import Grid
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array, selenographic_from_site
from perilune_shared.storage.files import sha256_of
from perilune_shared.storage.rasters import RasterFiles, opened_raster, raster_files

_AT_THE_MIDDLE = ElevationConfig()
_FIELD = "dataset.terrain.elevation"
_LARGEST_PIXELS = 100_000_000
"""Largest number of pixels of a model, including the ground added beyond its edge."""
_RESOLVED_PIXELS = 4.0
"""Smallest diameter of a crater that a model shows, pixels."""
_SWELL_M = 120.0
"""Standard deviation of the low-pass filter for a mirrored model, metres. Waves longer than about 4 times this value
count as long."""
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
    """Mapping between columns and rows and positions on the Moon."""
    latitude_deg: float
    """Latitude of the site, degrees."""
    longitude_deg: float
    """Longitude of the site, degrees."""
    pixel_m: float
    """Ground size of a pixel at the site, mean of both directions, metres."""
    pixel_sides_m: tuple[float, float]
    """Ground size of a pixel between rows and between columns, metres."""
    step_m: float
    """Quantisation step of the raster's heights if it is large enough to make terraces, metres; otherwise 0."""
    read_step: int
    """Number of raster pixels along the side of one pixel of the model; above 1 if the ground would have too many
    pixels."""
    hole_m: Array | None
    """Distance of each pixel (rows, columns) from the nearest known pixel, metres; None without holes."""
    source: str
    """File name (without folder and special characters) and SHA-256."""


def read_elevation(
    path: Path, config: ElevationConfig = _AT_THE_MIDDLE, ground_m: float | None = None
) -> ElevationModel:
    """Read an elevation model; its site is the site of `config`, or the middle of the raster.

    `ground_m` is the side of the ground around the site for which the model is needed, metres; None stands for
    UNSTATED_GROUND_M. A raster with more than `window.LARGEST_PIXELS` pixels is read only around this ground, at a
    lower resolution if the ground has too many pixels as well. If an edge of the raster's map crosses the ground, the
    columns are rearranged or resampled.

    Raises UserError if the model is missing, unreadable or empty, if it lacks a pixel size or a projection of the Moon,
    if the site is outside the model or in a hole, or if the values cannot be heights (`elevation.height_band`).

    Holes (nodata, NaN) are filled with the nearest known height. Heights may be elevations or radii: only differences
    matter, since the site is set to height 0. Quantised heights are smoothed within half a step
    (`perilune_render.terrain.elevation.quantisation`).
    """
    files = raster_files(path, field="dem", tiles=config.vrt_files)
    with opened_raster(files, "dem") as file:
        band = height_band(path, files, file, config)
        whole = map_of(path, file, config)
        site = site_in(path, whole, config)
        window = chosen_window(whole, site, ground_m)
        raster_map = whole.part(window.top, window.left, window.shape, window.step) if window.cut else whole
        height = read_window(band, whole, window)
        used = {Path(name).name for name in file.files}
    site = site_within(whole, raster_map, site)
    sides = _pixel_sides_m(raster_map, site)
    height = band.in_metres(height, min(n * side for n, side in zip(height.shape, sides, strict=True)))
    known = np.isfinite(height)
    if known.sum() < 16:
        raise UserError(path, "heights", f"{known.sum()} known", "an elevation model with data")
    if not known.all():
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    if config.site_px is not None or config.site_deg is not None:
        refuse_hole(path, whole, raster_map, known, site)
    step = step_of(height[known], float(np.mean(sides)))
    if step:
        height = smoothed(height, step)
    if not smooth_over(raster_map, site, UNSTATED_GROUND_M if ground_m is None else ground_m):
        pixel = sides[0] if whole.circle is not None else float(np.mean(sides))
        height, known, raster_map = resampled(
            height, known, raster_map, site, pixel, UNSTATED_GROUND_M if ground_m is None else ground_m
        )
        site = Site(*raster_map.middle, site.latitude_deg, site.longitude_deg)
        sides = _pixel_sides_m(raster_map, site)
    hole = distance_in_holes_m(known, sides)
    site_deg, pixel = (site.latitude_deg, site.longitude_deg), float(np.mean(sides))
    return ElevationModel(
        height, known, raster_map, *site_deg, pixel, sides, step, window.step, hole, _source_of(files, used)
    )


def read_site(path: Path, config: ElevationConfig = _AT_THE_MIDDLE) -> Site:
    """The site of an elevation model, without its heights. Raises the errors of `read_elevation`."""
    with opened_raster(raster_files(path, field="dem", tiles=config.vrt_files), "dem") as file:
        return site_in(path, map_of(path, file, config), config)


def _source_of(files: RasterFiles, used: set[str]) -> str:
    """File name (without folder and special characters) and SHA-256 of a raster.

    For several files, the hash is the hash of their hashes. A world file counts only if it was used.
    """
    path = files.paths[0]
    plain_name = re.sub(r"[^A-Za-z0-9._-]", "_", path.name)[-100:].lstrip("._-")
    hashes = [sha256_of(file) for name, file in files.named if file == path or Path(name).name in used]
    together = hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return f"{plain_name} sha256:{together}"


def raster_places(model: ElevationModel, x_m: Array, y_m: Array) -> tuple[Array, Array]:
    """Column and row in the raster of the positions x_m, y_m on O_L's plane; all arrays have one shape.

    Column and row are 0 at the raster's top left corner.
    """
    lat, lon = selenographic_from_site(x_m, y_m, model.latitude_deg, model.longitude_deg)
    column, row = model.raster.places(np.ravel(lat), np.ravel(lon))
    return column.reshape(np.shape(x_m)), row.reshape(np.shape(x_m))


def height_of_site_m(model: ElevationModel) -> float:
    """Height of the site above the sphere of MOON_RADIUS_M in the model, metres.

    Heights above half this radius are taken to be distances from the Moon's centre.
    """
    column, row = raster_places(model, np.zeros(1), np.zeros(1))
    height = float(ndimage.map_coordinates(model.height_m, [row - 0.5, column - 0.5], order=3, mode="nearest")[0])
    return height - MOON_RADIUS_M if height > MOON_RADIUS_M / 2 else height


def resolved_m(model: ElevationModel) -> float:
    """Smallest diameter of a crater that a model shows, metres: four pixels.

    Smaller craters are generated.
    """
    return _RESOLVED_PIXELS * model.pixel_m


def beyond_m(model: ElevationModel, column: Array, row: Array) -> Array:
    """Distance, metres, of raster coordinates from known ground; above 0 in holes and outside the model."""
    rows, columns = model.height_m.shape
    down = np.maximum(np.maximum(-row, row - rows), 0) * model.pixel_sides_m[0]
    across = np.maximum(np.maximum(-column, column - columns), 0) * model.pixel_sides_m[1]
    beyond = np.hypot(down, across)
    if model.hole_m is not None:
        beyond += ndimage.map_coordinates(model.hole_m, [row - 0.5, column - 0.5], order=1, mode="nearest")
    return beyond


def refuse_beyond(model: ElevationModel, grid: Grid, outside: Outside) -> None:
    """Raise UserError if `outside` is "refuse" and the ground extends beyond the model's raster."""
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


def refuse_unseen(model: ElevationModel, grid: Grid, config: ElevationConfig) -> None:
    """Raise UserError if the model has no height on the ground, unless the configuration allows this."""
    if not config.allow_unseen and _real_share(model, grid) == 0:
        found = f"no height within {grid.extent_m:.0f} m x {grid.extent_m:.0f} m of ground"
        site_text = f"latitude {model.latitude_deg:.4f}, longitude {model.longitude_deg:.4f}"
        raise UserError(
            model.source,
            "dem",
            f"{found} around {site_text}",
            f"a model or a site ({_FIELD}.site_*) with heights there, or {_FIELD}.allow_unseen=true",
        )


def _real_share(model: ElevationModel, grid: Grid) -> float:
    """Share of the square ground around the site where the model has heights."""
    net = np.linspace(-grid.extent_m / 2, grid.extent_m / 2, 129)
    return float((beyond_m(model, *raster_places(model, *np.meshgrid(net, net))) == 0).mean())


def _percent(share: float) -> str:
    """A share in percent, with enough decimals to differ from 0 and 100 %."""
    text = f"{share:.0%}"
    if 0 < share < 1 and text in ("0%", "100%"):
        text = f"{min(max(share, 0.0001), 0.9999):.2%}"
    return text


def remarks(model: ElevationModel, grid: Grid, outside: Outside) -> list[str]:
    """Messages for the user about a model, one per line, shown before its ground is generated."""
    lines = []
    name = model.source.split(" sha256:")[0]
    if model.read_step > 1:
        lines.append(
            f"{name}: read at {model.pixel_m:.3g} m, {model.read_step} x {model.read_step} of its pixels, since the "
            f"ground is {grid.extent_m / 1000:.3g} km wide"
        )
    if model.step_m:
        lines.append(f"{name}: heights are in steps of {model.step_m:.3g} m; they are smoothed within half a step")
    share = _real_share(model, grid)
    if share < 1:
        rest = "procedural" if outside == "procedural" else "its mirror image"
        side = f"{grid.extent_m:.0f} m"
        lines.append(f"{name}: {_percent(share)} of the ground, {side} x {side}, is real, the rest {rest}")
    return lines


def base_heights(model: ElevationModel, grid: Grid, outside: Outside = "procedural") -> tuple[Array, Array]:
    """Heights on the grid, and distances from known ground, metres, (n_vertices,) each.

    The site is at height 0. Heights are interpolated bicubically. Beyond the model the ground continues smoothly
    (`perilune_render.terrain.elevation.continuation`), and relief and craters are added later; with `outside` "mirror"
    the model is mirrored. Raises UserError if the ground extends beyond the model and `outside` is "refuse".
    """
    rows, columns = model.height_m.shape
    # Pixel coordinates vary slowly over a site, so project only a coarse lattice and interpolate.
    net = np.linspace(-grid.extent_m / 2, grid.extent_m / 2, 65)
    column, row = raster_places(model, *np.meshgrid(net, net))
    x, y = grid.vertices_xy()
    from scipy.interpolate import RectBivariateSpline  # imported here: it takes 0.2 s, only for elevation models

    column, row = (RectBivariateSpline(net, net, values).ev(y, x) for values in (column, row))
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
    coordinates = [row - 0.5 + margin, column - 0.5 + margin]
    if outside == "mirror":
        padded = _mirrored(model.height_m, margin, model.pixel_m)
        height = ndimage.map_coordinates(padded, coordinates, order=3, mode="nearest")
    else:
        centres = [np.arange(n + 2 * margin) + 0.5 - margin for n in (rows, columns)]
        far = beyond_m(model, *np.meshgrid(centres[1], centres[0]))
        padded = continued(model.height_m, far, margin, model.pixel_sides_m)
        height = ndimage.map_coordinates(padded, coordinates, order=3, mode="nearest")
        height += mean_slope(model.height_m, row - 0.5, column - 0.5, beyond, min(sides))
    return height - height[middle], beyond


def _mirrored(height_m: Array, margin: int, pixel_m: float) -> Array:
    """Heights extended by `margin` pixels on each side, without a crease at the edge of the model.

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
    """Ground size of a pixel at the site between rows and between columns, from great-circle distances.

    Approximation for small differences of latitude and longitude; wrong within two pixels of a pole.
    """
    # At the last row or column, step inwards, since latitudes may end there.
    down, across = (-1 if index + 1 > n else 1 for index, n in zip((site.row, site.column), raster.shape, strict=True))
    lats, lons = raster.selenographic(
        np.array([site.column, site.column + across]), np.array([site.row + down, site.row])
    )
    to_east = np.cos(np.radians(site.latitude_deg)) * np.radians((lons - site.longitude_deg + 180) % 360 - 180)
    to_north = np.radians(lats - site.latitude_deg)
    high, wide = MOON_RADIUS_M * np.hypot(to_east, to_north)
    return float(high), float(wide)
