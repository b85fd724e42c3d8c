"""Settings of the ground: the section `dataset.terrain`."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_render.config_values import NotNegative, Positive, Share, Span
from perilune_shared.config import Section

LARGEST_SPACING_PX = 4.0
"""Largest vertex spacing over the smallest ground pixel."""


class CratersConfig(Section):
    """The crater population."""

    surface_age_gyr: Annotated[float, Field(gt=0, le=4.4)] = 3.5
    """Age of the surface, which sets the production of large craters, Gyr."""
    equilibrium: Literal["trask", "minton", "viper", "chang_e_4"] = "chang_e_4"
    """Law at which small craters are erased as fast as they form."""
    equilibrium_share: Span = Span(low=0.9, high=1.7)
    """Density of small craters over the equilibrium law, drawn for each scene."""
    min_diameter_spacings: Annotated[float, Field(ge=1.5)] = 2.2
    """Smallest crater over the local vertex spacing."""
    max_diameter_m: Positive = 800.0
    """Largest crater, metres."""
    profile: Literal["fassett_thomson", "pangu"] = "fassett_thomson"
    """Shape of a fresh crater."""
    depth: Literal["stopar", "pike"] = "stopar"
    """Law of a fresh crater's depth."""
    irregularity: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Departure of outline and rim height from a circle; at 1 the outline strays by about one percent of the radius."""
    flat_floor_share: Share = 0.15
    """Share of the craters that form with a flat floor, as in thin regolith over rock."""
    secondary_share: Share = 0.08
    """Share of the craters under 30 m that lie in clusters of secondaries."""
    n_rayed: Annotated[int, Field(ge=0, le=100)] = 4
    """How many craters have bright rays: the largest among the fresh ones."""


class BouldersConfig(Section):
    """The boulder population."""

    density: NotNegative = 0.1
    """Times the published size-frequency law, on the plain."""
    field_density: NotNegative = 100.0
    """Density at the rim of a newly formed crater over that of the plain."""
    min_diameter_spacings: Annotated[float, Field(ge=0.3)] = 0.7
    """Smallest boulder over the local vertex spacing."""
    max_diameter_m: Positive = 5.0
    """Largest boulder, metres."""
    n_shapes: Annotated[int, Field(ge=1, le=100)] = 12
    """Different rocks in a scene."""


class ReliefConfig(Section):
    """Self-affine relief."""

    hurst_exponent: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """How slopes fall with wavelength, L^(H-1)."""
    rms_slope_deg: Span = Span(low=2.0, high=4.5)
    """Root mean square slope of all waves down to a metre, without craters, drawn for each scene, degrees."""
    longest_wavelength_m: Positive = 1600.0
    """Longest wave, metres."""

    @model_validator(mode="after")
    def _gentle(self) -> "ReliefConfig":
        if not 0 <= self.rms_slope_deg.low <= self.rms_slope_deg.high <= 30:
            raise ValueError("rms_slope_deg from 0 to 30")
        return self


Outside = Literal["procedural", "refuse", "mirror"]


class ElevationConfig(Section):
    """How an elevation model is used."""

    outside: Outside = "procedural"
    """Ground beyond the model's edge: procedural with the model's statistics, refused, or the model's mirror image."""


class TerrainConfig(Section):
    """The ground."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = -45.5
    """Latitude of the site, degrees; an elevation model has its own."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 177.6
    """Longitude of the site, degrees; an elevation model has its own."""
    spacing_px: Annotated[float, Field(gt=0, le=LARGEST_SPACING_PX)] = 0.5
    """Vertex spacing over the smallest ground pixel from which a place is seen."""
    max_vertices: Annotated[int, Field(ge=10_000, le=40_000_000)] = 12_000_000
    """Most vertices of the ground; a camera and flight that need more are refused."""
    craters: CratersConfig = CratersConfig()
    """Craters."""
    boulders: BouldersConfig = BouldersConfig()
    """Boulders."""
    relief: ReliefConfig = ReliefConfig()
    """Relief."""
    dem: str | None = None
    """A GeoTIFF elevation model as the base, or null."""
    elevation: ElevationConfig = ElevationConfig()
    """Use of the elevation model."""
    catalogue: str | None = None
    """A CSV of the model's own craters (longitude_deg, latitude_deg, diameter_m), which become labels, or null."""
