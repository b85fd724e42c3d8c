"""Elevation models for tests, written as GeoTIFF."""

import numpy as np
import rasterio

POLAR = "+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m"
"""Projection about the Moon's south pole."""
PLACED = rasterio.Affine(5, 0, 1e5, 0, -5, 0)


def write(path, height, crs, transform):
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=height.shape[0],
        width=height.shape[1],
        count=1,
        dtype="float32",
        crs=crs,
        transform=transform,
        nodata=-9999,
    ) as raster:
        raster.write(height.astype(np.float32), 1)
    return path


def rough(seed=1, n=150):
    """Return smooth random heights (n, n), a few metres high."""
    rng = np.random.default_rng(seed)
    i, j = np.mgrid[:n, :n]
    waves = [(rng.uniform(0, 6.3), rng.uniform(0, 6.3), 2.0**k) for k in range(5, 9)]
    return sum(w / 20 * np.sin(2 * np.pi * (i * np.cos(a) + j * np.sin(a)) / w + b) for a, b, w in waves)
