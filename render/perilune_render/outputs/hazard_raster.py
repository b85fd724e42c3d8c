"""GeoTIFF of a hazard map."""

import numpy as np

from perilune_render.outputs.hazard import LAYERS, HazardMap
from perilune_render.terrain.export import site_profile


def hazard_tiff(hazard: HazardMap, latitude_deg: float, longitude_deg: float) -> bytes:
    """A float32 GeoTIFF with a named band for each layer: north up, azimuthal equidistant about the site."""
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
