"""Hazard map of a scene: slope, roughness, boulders and shadow under the footprint of a lander.

The definitions come from hazard detection in the ALHAT project (Johnson et al. 2008, IEEE Aerospace Conference,
"Analysis of on-board hazard detection and avoidance for safe lunar landing"): a plane is fitted to the heights in a
footprint. The slope is the slope of this plane; the roughness is the largest height of the surface above or below it.
Deviations from the paper: the map shows the true ground, not measurements; the plane is fitted by least squares to the
ground without boulders, but boulders count in the roughness.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perilune_render.config.outputs import HazardConfig
from perilune_render.engines.heightfield.query import first_hits, heights_m
from perilune_render.engines.heightfield.surface import Surface
from perilune_render.provenance.kernels import njit
from perilune_render.terrain.boulders import highest_points
from perilune_render.terrain.export import site_profile
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array

LAYERS = {
    "height": "m",
    "slope": "deg",
    "roughness": "m",
    "boulder": "m",
    "shadow": "1",
    "safe": "1",
}
"""Layers of a map, in order, with their units."""
FRAME_LAYERS = ("slope", "roughness", "boulder", "safe")
"""Layers that become channels of the frames' EXRs with the setting `frame_channels`."""
_LIFT_M = 1e-3
"""Height above its facet at which a shadow ray starts, metres."""
_ROWS_AT_ONCE = 128


@dataclass(frozen=True, slots=True)
class HazardMap:
    """Layers of n x n square pixels around the site; rows go south (y of O_L), columns east (-x of O_L)."""

    pixel_m: float
    """Size of a pixel, metres."""
    layers: dict[str, np.ndarray]
    """Layers (n, n) float32 by the names in LAYERS. `height` is the height of the surface with boulders at the pixel's
    centre. `slope`, `roughness`, `boulder` (largest boulder height) and `shadow` (share in shadow) describe the
    footprint around the pixel's centre. `safe` is 1 or 0."""

    def at(self, x_m: Array, y_m: Array) -> dict[str, np.ndarray]:
        """Values (...) float32 of the FRAME_LAYERS at positions (...) in O_L; NaN outside the map."""
        n = len(self.layers["safe"])
        with np.errstate(invalid="ignore"):
            column, row = (np.floor(offset_m / self.pixel_m + n / 2) for offset_m in (-x_m, y_m))
            inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
        where = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
        return {name: np.where(inside, self.layers[name][where], np.float32(np.nan)) for name in FRAME_LAYERS}


def check_hazard(config: HazardConfig, grid: Grid) -> None:
    """Raise UserError unless all footprints of a map are on the ground of `grid`."""
    needed = (config.side_px() + 2 * config.margin_px() + 1) * config.pixel_m
    if needed > grid.extent_m:
        most = grid.extent_m - config.footprint_m - config.pixel_m
        expected = f"at most {most:.0f}: the ground is {grid.extent_m:.0f} m wide, and footprints lie on it"
        raise UserError("configuration", "dataset.hazard.extent_m", f"{config.extent_m:g}", expected)


def hazard_map(surface: Surface, scene: Scene, sun: Array, config: HazardConfig) -> HazardMap:
    """The hazard map of a scene lit from `sun` (3,), a unit vector in O_L.

    Heights and shadows are evaluated at pixel centres. Boulders of every size count with their highest points. The Sun
    is treated as a point, so shadows have no penumbra. Takes a second for 500 x 500 pixels.
    """
    n, margin = config.side_px(), config.margin_px()
    side = n + 2 * margin
    centre = (np.arange(side) + 0.5 - side / 2) * config.pixel_m
    ground, top, dark = (np.empty((side, side)) for _ in range(3))
    for first in range(0, side, _ROWS_AT_ONCE):
        rows = slice(first, min(first + _ROWS_AT_ONCE, side))
        # O_L's x points west and y south; columns go east and rows south.
        y, x = (each.ravel() for each in np.meshgrid(centre[rows], -centre, indexing="ij"))
        ground[rows] = heights_m(surface, x, y, boulders=False).reshape(-1, side)
        height, shaded = _top_and_shadow(surface, x, y, sun)
        top[rows], dark[rows] = height.reshape(-1, side), shaded.reshape(-1, side)
    above = np.maximum(top - ground, 0.0)
    _raise_to_boulders(above, surface, scene, config.pixel_m)
    offset = np.arange(-margin, margin + 1)
    down, right = np.meshgrid(offset, offset, indexing="ij")
    disc = np.hypot(down, right) * config.pixel_m <= config.footprint_m / 2 * (1 + 1e-9)
    footprint = _Footprint(down[disc], right[disc], margin, config.pixel_m)
    measured = _footprints(ground, above, dark, footprint)
    slope, roughness, boulder, shadow = (layer.astype(np.float32) for layer in measured)
    safe = (slope <= config.max_slope_deg) & (roughness <= config.max_roughness_m)
    safe &= (boulder <= config.max_boulder_m) & (shadow <= config.max_shadow_share)
    inner = slice(margin, margin + n)
    layers = (top[inner, inner].astype(np.float32), slope, roughness, boulder, shadow, safe.astype(np.float32))
    return HazardMap(config.pixel_m, dict(zip(LAYERS, layers, strict=True)))


def _top_and_shadow(surface: Surface, x_m: Array, y_m: Array, sun: Array) -> tuple[Array, Array]:
    """Heights (N,) of the surface with boulders, metres, and shadow: 1 in shadow, else 0."""
    above = surface.ground.highest_m + 1.0
    start = np.stack([x_m, y_m, np.full(len(x_m), above)], axis=1)
    distance, normal = first_hits(surface, start, np.tile([0.0, 0.0, -1.0], (len(x_m), 1)))
    start[:, 2] -= distance
    hit, _ = first_hits(surface, start + _LIFT_M * normal, np.tile(sun, (len(x_m), 1)))
    return above - distance, (np.isfinite(hit) | (normal @ sun <= 0)).astype(np.float64)


def _raise_to_boulders(above: Array, surface: Surface, scene: Scene, pixel_m: float) -> None:
    """Raise `above` (side, side) to the highest point of the boulders in each pixel.

    `above` holds heights above the ground, metres.
    """
    if not len(scene.boulders):
        return
    points = highest_points(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)
    side = len(above)
    column, row = (
        np.floor(offset_m / pixel_m + side / 2).astype(np.int64) for offset_m in (-points[:, 0], points[:, 1])
    )
    inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
    x, y, z = points[inside].T
    np.maximum.at(above, (row[inside], column[inside]), z - heights_m(surface, x, y, boulders=False))


class _Footprint(NamedTuple):
    """The M pixels under a lander, as offsets from the pixel at its centre, symmetric about 0."""

    down: np.ndarray
    """Rows southwards (M,)."""
    right: np.ndarray
    """Columns eastwards (M,)."""
    margin: int
    """Largest offset, pixels."""
    pixel_m: float
    """Size of a pixel, metres."""


@njit()
def _footprints(ground, above, dark, footprint):
    """Slope (degrees), roughness, largest boulder (metres) and share of shadow of each pixel's footprint.

    The arrays (side, side) extend beyond the pixels of the map by the margin of the footprint. The footprint is
    symmetric, so the sums for the fit of the plane have no mixed terms.
    """
    down, right, margin, pixel_m = footprint
    n, m = len(ground) - 2 * margin, len(down)
    slope, roughness, boulder, shadow = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    squares = 0.0
    for k in range(m):
        squares += (right[k] * pixel_m) ** 2
    for row in range(n):
        for column in range(n):
            middle = ground[row + margin, column + margin]
            mean, east, south, shade = 0.0, 0.0, 0.0, 0.0
            for k in range(m):
                j, i = row + margin + down[k], column + margin + right[k]
                height = ground[j, i] - middle
                mean += height
                east += right[k] * pixel_m * height
                south += down[k] * pixel_m * height
                shade += dark[j, i]
            mean /= m
            east /= squares
            south /= squares
            largest, highest = 0.0, 0.0
            for k in range(m):
                j, i = row + margin + down[k], column + margin + right[k]
                plane = mean + pixel_m * (east * right[k] + south * down[k])
                largest = max(largest, abs(ground[j, i] - middle + above[j, i] - plane))
                highest = max(highest, above[j, i])
            slope[row, column] = np.degrees(np.arctan(np.sqrt(east * east + south * south)))
            roughness[row, column] = largest
            boulder[row, column] = highest
            shadow[row, column] = shade / m
    return slope, roughness, boulder, shadow


def hazard_tiff(hazard: HazardMap, latitude_deg: float, longitude_deg: float) -> bytes:
    """The content of a float32 GeoTIFF with a named band for each layer.

    North is up; the projection is azimuthal equidistant around the site.
    """
    from rasterio.io import MemoryFile

    n = len(hazard.layers["safe"])
    profile = site_profile(latitude_deg, longitude_deg, n, hazard.pixel_m, len(LAYERS))
    with MemoryFile() as memory:
        with memory.open(**profile, nodata=np.nan) as raster:
            for band, (name, unit) in enumerate(LAYERS.items(), 1):
                raster.write(hazard.layers[name], band)
                raster.set_band_description(band, name)
                raster.set_band_unit(band, unit)
        return bytes(memory.getbuffer())
