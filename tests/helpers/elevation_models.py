"""Elevation models for tests, written as GeoTIFF."""

import numpy as np
import rasterio
import rasterio.warp

POLAR = "+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m"
"""Projection about the Moon's south pole."""
MOON = "+proj=longlat +R=1737400"
HILLY = "+proj=aeqd +lat_0=-20 +lon_0=-20 +R=1737400 +units=m"
PLACED = rasterio.Affine(5, 0, 1e5, 0, -5, 0)


def write(path, height, crs, transform, units=None, nodata=-9999, **options):
    """Write heights (rows, columns), or several bands of them, as float32 GeoTIFF."""
    bands = height.reshape(-1, *height.shape[-2:])
    options = {"dtype": "float32"} | options
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=bands.shape[1],
        width=bands.shape[2],
        count=len(bands),
        crs=crs,
        transform=transform,
        nodata=nodata,
        **options,
    ) as raster:
        raster.write(bands.astype(options["dtype"]))
        if units is not None:
            raster.units = (units,) * len(bands)
    return path


def smooth_moon(latitude_deg, longitude_deg):
    """Heights (...), metres, of a ground that is smooth everywhere on the sphere, over its poles too."""
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    return 900 * np.sin(9 * x + 1) + 700 * np.sin(11 * y) + 500 * np.sin(7 * z + 2 * x) + 300 * np.cos(13 * x * y)


def moon_raster(path, crs, transform, shape, **options):
    """Write `smooth_moon` as a raster (rows, columns); -9999 off its map."""
    column, row = (each.ravel() for each in np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5))
    x, y = transform @ (column, row)
    longitude, latitude = (np.array(v) for v in rasterio.warp.transform(crs, MOON, x, y))
    with np.errstate(invalid="ignore"):
        height = np.nan_to_num(smooth_moon(latitude, longitude), nan=-9999, posinf=-9999, neginf=-9999)
    return write(path, height.reshape(shape), crs, transform, **options)


def hilly(east_m, north_m):
    """Heights (...), metres, of a hill, a pit and a slope within a kilometre of a site."""
    hill = 300 * np.exp(-((east_m - 300) ** 2 + (north_m - 200) ** 2) / (2 * 150**2))
    pit = 120 * np.exp(-((east_m + 400) ** 2 + (north_m + 100) ** 2) / (2 * 100**2))
    return hill - pit + 0.05 * east_m + 0.02 * north_m - 1500


def hilly_raster(path, factor=1.0, offset=0.0, **options):
    """Write `hilly` times a factor plus an offset, 400 x 400 pixels of 5 m about latitude -20, longitude -20."""
    side = np.arange(-997.5, 1000, 5)
    height = hilly(side[None, :], -side[:, None]) * factor + offset
    return write(path, height, HILLY, rasterio.Affine(5, 0, -1000, 0, -5, 1000), **options)


def rough(seed=1, n=150):
    """Return smooth random heights (n, n), a few metres high."""
    rng = np.random.default_rng(seed)
    i, j = np.mgrid[:n, :n]
    waves = [(rng.uniform(0, 6.3), rng.uniform(0, 6.3), 2.0**k) for k in range(5, 9)]
    return sum(w / 20 * np.sin(2 * np.pi * (i * np.cos(a) + j * np.sin(a)) / w + b) for a, b, w in waves)
