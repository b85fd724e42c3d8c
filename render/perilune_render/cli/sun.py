"""Warn if the settings state a higher Sun than the landing site ever has."""

from pathlib import Path

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_shared.console.terminal import say
from perilune_shared.dataset.names import Kind

_LARGEST_SUN_LATITUDE_DEG = 1.59
"""Largest distance of the Sun from the Moon's equator, degrees: 1.54, the mean tilt of the Moon's axis to the ecliptic,
and libration (tests/render/poses/test_suns.py)."""


def highest_sun_deg(latitude_deg: float) -> float:
    """The highest elevation of the Sun above level ground at a latitude, degrees."""
    return min(90.0, 90.0 - abs(latitude_deg) + _LARGEST_SUN_LATITUDE_DEG)


def warn_of_sun(config: DatasetConfig, where: str, elevation_deg: float) -> None:
    """Warn if the Sun never reaches this elevation at the site; `where` names the setting.

    Procedural ground at the default latitude stands for any place on the Moon, so it causes no warning. Raises
    UserError if the elevation model cannot be read.
    """
    latitude = _stated_latitude_deg(config)
    if latitude is None or elevation_deg <= highest_sun_deg(latitude):
        return
    latitude_text = f"{abs(latitude):.1f} degrees {'south' if latitude < 0 else 'north'}"
    say(
        f"warning: {where}: got {elevation_deg:g} degrees, expected at most {highest_sun_deg(latitude):.1f}: "
        f"at {latitude_text}"
        " the Sun is never higher"
    )


def warn_of_suns(config: DatasetConfig, kinds: tuple[Kind, ...]) -> None:
    """Warn if a dataset of one of these kinds may draw a higher Sun than the site ever has."""
    for kind in kinds:
        warn_of_sun(config, f"dataset.{kind}.sun.elevation_deg", config.kind(kind).sun.elevation_deg.high)


def _stated_latitude_deg(config: DatasetConfig) -> float | None:
    terrain = config.terrain
    if terrain.dem is None:
        usual = TerrainConfig.model_fields["latitude_deg"].default
        return None if terrain.latitude_deg == usual else terrain.latitude_deg
    # This import needs rasterio, which is used only for elevation models.
    from perilune_render.terrain.elevation.model import read_site

    return read_site(Path(terrain.dem), terrain.elevation).latitude_deg
