"""Locate an image on the Moon, and convert detections to GeoJSON.

A georeference comes from the GeoTIFF itself, or from a world file (.pgw, .tfw, .jgw) and a .prj file beside the image.
Reading it needs rasterio and pyproj (the extra `geo`).
"""

import functools
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M
from perilune_shared.storage.rasters import PICTURE_DRIVERS, opened_raster, raster_files
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate.split_evaluation import ellipse_columns
from perilune_train.detect.images.read import picture_size, stored_from_upright

Array = NDArray[np.float64]
_MOON = f"+proj=longlat +R={MOON_RADIUS_M:.0f} +no_defs"
MOON_CRS = "urn:ogc:def:crs:IAU:2015:30100"
"""Longitude and latitude, degrees, on the sphere of the Moon's mean radius."""
_MAX_PRJ = 2**16
_CORNERS = 32
_GRID = 17
"""Number of sample points per side to test whether an image lies on its map. The corners alone are not enough: in an
image of the full disc the corners are off the map."""
_DECIMALS = 8
"""Decimals of degrees: 0.3 mm on the ground."""


@dataclass(frozen=True)
class Georeference:
    """Conversion from pixels to longitude and latitude on the Moon."""

    transform: tuple[float, float, float, float, float, float]
    """a, b, c, d, e, f: map x = a column + b row + c, map y = d column + e row + f.

    Columns and rows count from the outer corner of the first pixel."""
    projection: str
    """The map's coordinate reference system, WKT."""
    path: Path
    """The image, named in error messages."""

    def lon_lat_deg(self, pixels: Array) -> Array:
        """East longitude and latitude (N, 2), degrees, of pixel coordinates (N, 2); infinite off the map.

        Raises UserError if the projection is not on the Moon.
        """
        from pyproj.exceptions import ProjError

        a, b, c, d, e, f = self.transform
        x, y = a * pixels[:, 0] + b * pixels[:, 1] + c, d * pixels[:, 0] + e * pixels[:, 1] + f
        try:
            return np.stack(_lon_lat_from_map(self.projection).transform(x, y), axis=1)
        except ProjError as error:
            raise UserError(self.path, "projection", error, "a coordinate reference system of the Moon") from None


@functools.cache
def _lon_lat_from_map(projection: str) -> Any:
    """The pyproj.Transformer to longitude and latitude on the Moon. Raises ProjError for other bodies."""
    from pyproj import Transformer

    return Transformer.from_crs(projection, _MOON, always_xy=True)


def read_georeference(path: Path) -> Georeference | None:
    """Read the georeference of an image; None if its transform or projection is missing. Needs rasterio.

    Raises UserError if the projection is not on the Moon.
    """
    from rasterio.crs import CRS
    from rasterio.errors import RasterioError

    prj = path.with_suffix(".prj")
    with opened_raster(raster_files(path, PICTURE_DRIVERS, "image"), "image") as image:
        transform, projection = image.transform, image.crs
    if projection is None and prj.is_file():
        try:
            projection = CRS.from_wkt(_prj_text(prj), morph_from_esri_dialect=True)
        except (RasterioError, ValueError) as error:
            raise UserError(prj, "georeference", error, "a projection as text (.prj)") from None
    if transform.is_identity or transform.determinant == 0 or projection is None:
        return None
    # A georeference refers to stored pixels, but detections refer to pixels of the upright picture.
    stored, map_from_stored = stored_from_upright(path), np.reshape(tuple(transform)[:6], (2, 3))
    a, b, c, d, e, f = (map_from_stored[:, :2] @ stored + map_from_stored * [0, 0, 1]).ravel().tolist()
    size = picture_size(path)
    reference = Georeference((a, b, c, d, e, f), projection.to_wkt(), path)
    grid = np.stack(np.meshgrid(*(np.linspace(0, side, _GRID) for side in size)), axis=-1).reshape(-1, 2)
    if not np.isfinite(reference.lon_lat_deg(grid)).all(axis=1).any():
        raise UserError(path, "projection", "none of its pixels on the map", "an image of a place on the Moon")
    return reference


def _prj_text(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(_MAX_PRJ).decode("utf-8")


def can_read_georeferences() -> bool:
    """Whether rasterio and pyproj are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("rasterio", "pyproj"))


def features(name: str, detections: Detections, reference: Georeference) -> list[dict[str, Any]]:
    """GeoJSON features of an image's detections: the ellipse of each as a polygon, with properties.

    The properties have the columns of `ellipse_columns`, and both semi-axes in metres on the ground.

    If a polygon crosses 180 degrees, its longitudes continue beyond 180. A polygon around a pole is not valid in
    longitude and latitude: its vertices are correct, but its area is not. Detections that extend off the map are
    omitted.
    """
    from pyproj import Geod

    if not len(detections.boxes):
        return []
    centre, semi_axes = detections.ellipses[:, :2], detections.ellipses[:, 2:4]
    cos, sin = np.cos(detections.ellipses[:, 4]), np.sin(detections.ellipses[:, 4])
    # Columns: directions of the semi-major and of the semi-minor axis (N, 2, 2).
    axes = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1) * semi_axes[:, None]
    angle = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixels = np.concatenate([centre[:, None], centre[:, None] + ring @ np.swapaxes(axes, 1, 2)], axis=1)
    lon_lat_deg = reference.lon_lat_deg(pixels.reshape(-1, 2)).reshape(pixels.shape)
    on_map = np.isfinite(lon_lat_deg).all(axis=(1, 2))
    lon_lat_deg, mapped = lon_lat_deg[on_map], detections.take(on_map)
    lon_lat_deg[:, 1:, 0] -= 360 * np.round((lon_lat_deg[:, 1:, 0] - lon_lat_deg[:, :1, 0]) / 360)
    quarter = _CORNERS // 4
    sphere = Geod(a=MOON_RADIUS_M, b=MOON_RADIUS_M)
    ends = ((lon_lat_deg[:, 1 + k], lon_lat_deg[:, 1 + k + 2 * quarter]) for k in (0, quarter))
    along, across = (sphere.inv(*start.T, *end.T)[2] for start, end in ends)
    columns = {
        "diameter_m": np.sqrt(along * across),
        "diameter_px": 2 * np.sqrt(mapped.ellipses[:, 2:4].prod(axis=1)),
        "centre_x_px": mapped.ellipses[:, 0],
        "centre_y_px": mapped.ellipses[:, 1],
        "semi_major_m": along / 2,
        "semi_minor_m": across / 2,
        **ellipse_columns(mapped),
    }
    return [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [_ring(position[1:])]},
            "properties": {
                "image": name,
                "score": round(float(mapped.scores[k]), 6),
                "longitude_deg": round(float(position[0, 0]), _DECIMALS),
                "latitude_deg": round(float(position[0, 1]), _DECIMALS),
                **{name: _rounded(values[k]) for name, values in columns.items()},
            },
        }
        for k, position in enumerate(lon_lat_deg)
    ]


def _rounded(value: float) -> float | None:
    """A number with three decimals; None for NaN, which JSON does not know."""
    return round(float(value), 3) if np.isfinite(value) else None


def collection(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """A GeoJSON FeatureCollection in the Moon's longitude and latitude.

    Deviation from RFC 7946, which allows only the Earth's WGS 84: the member `crs` of GeoJSON 2008 names the Moon's
    coordinate system. GDAL and QGIS read this member; other programs ignore it.
    """
    crs = {"type": "name", "properties": {"name": MOON_CRS}}
    return {"type": "FeatureCollection", "name": "craters", "crs": crs, "features": parts}


def _ring(corners: Array) -> list[list[float]]:
    """A closed ring, counter-clockwise as required by RFC 7946."""
    x, y = corners.T - corners[0][:, None]
    if x @ np.roll(y, -1) - y @ np.roll(x, -1) < 0:
        corners = corners[::-1]
    return np.round(np.concatenate([corners, corners[:1]]), _DECIMALS).tolist()
