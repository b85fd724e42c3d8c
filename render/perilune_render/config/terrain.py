"""Settings of the terrain: the section `dataset.terrain`."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_render.config.values import Length, Share, Span, Within
from perilune_shared.config.resolve import Section

_Place = Annotated[float, Field(ge=0, le=10_000_000)]
LARGEST_SPACING_PX = 4.0
"""Largest allowed value of `spacing_px`."""


class CratersConfig(Section):
    """The crater population."""

    surface_age_gyr: Annotated[float, Field(gt=0, le=4.4)] = 3.5
    """Age of the surface, which sets the number of large craters, Gyr."""
    equilibrium: Literal["trask", "minton", "viper", "chang_e_4"] = "chang_e_4"
    """Equilibrium law: the density above which small craters are erased as fast as they form."""
    equilibrium_share: Annotated[Span, Within(0, 100)] = Span(low=0.9, high=1.7)
    """Density of small craters, as a multiple of the equilibrium density, drawn for each scene."""
    min_diameter_spacings: Annotated[float, Field(ge=1.5, le=1000)] = 2.2
    """Diameter of the smallest crater, in local vertex spacings."""
    max_diameter_m: Annotated[float, Field(gt=0, le=100_000)] = 800.0
    """Diameter of the largest crater, metres."""
    profile: Literal["fassett_thomson", "pangu"] = "fassett_thomson"
    """Shape of a fresh crater."""
    depth: Literal["stopar", "pike"] = "stopar"
    """Depth law of fresh craters."""
    irregularity: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Irregularity of outline and rim height. At 0 the outline is a circle; at 1 it deviates from one by about 1 % of
    the radius."""
    flat_floor_share: Share = 0.15
    """Share of craters that form with a flat floor, as in thin regolith over rock."""
    secondary_share: Share = 0.08
    """Share of craters below 30 m that belong to clusters of secondaries."""
    n_rayed: Annotated[int, Field(ge=0, le=100)] = 4
    """Number of craters with bright rays; the largest fresh craters have them."""


class BouldersConfig(Section):
    """The boulder population."""

    density: Annotated[float, Field(ge=0, le=1000)] = 0.1
    """Boulder density on the plain, as a multiple of the published size-frequency law."""
    field_density: Annotated[float, Field(ge=0, le=100_000)] = 100.0
    """Boulder density at the rim of a newly formed crater, as a multiple of the density on the plain."""
    min_diameter_spacings: Annotated[float, Field(ge=0.3, le=1000)] = 0.7
    """Diameter of the smallest boulder, in local vertex spacings."""
    max_diameter_m: Annotated[float, Field(gt=0, le=1000)] = 5.0
    """Diameter of the largest boulder, metres."""
    n_shapes: Annotated[int, Field(ge=1, le=100)] = 12
    """Number of different rock shapes in a scene."""


class ReliefConfig(Section):
    """The self-affine relief of the ground, without craters."""

    hurst_exponent: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """Hurst exponent H: slopes fall with wavelength L as L^(H-1)."""
    rms_slope_deg: Annotated[Span, Within(0, 30)] = Span(low=2.0, high=4.5)
    """RMS slope over wavelengths down to 1 m, without craters, drawn for each scene, degrees."""
    longest_wavelength_m: Length = 1600.0
    """Longest wavelength of the relief, metres."""

    @model_validator(mode="after")
    def _slope_in_range(self) -> "ReliefConfig":
        if not 0 <= self.rms_slope_deg.low <= self.rms_slope_deg.high <= 30:
            raise ValueError("rms_slope_deg from 0 to 30")
        return self


Outside = Literal["procedural", "refuse", "mirror"]
METRES_PER_UNIT = {"m": 1.0, "km": 1000.0, "ft": 0.3048, "us-ft": 1200 / 3937, "cm": 0.01, "mm": 0.001}
"""Length of each unit of heights, metres."""
HeightUnit = Literal["m", "km", "ft", "us-ft", "cm", "mm"]
SITE_FIELDS = ("site_latitude_deg", "site_longitude_deg", "site_column_px", "site_row_px")
"""Settings that place the site in an elevation model: set the first two, the last two, or none."""
FILE_FIELDS = ("height_unit", "band", "nodata", "crs", "vrt_files", "allow_unseen", "citation")
"""Settings that supply what the file of an elevation model does not state."""


RimSource = Literal["catalogue", "measured"]


class CatalogueColumnsConfig(Section):
    """Columns of a crater catalogue. If all are null, the columns of known catalogues are recognised."""

    longitude_deg: str | None = None
    """Column of the longitude, east positive, degrees."""
    latitude_deg: str | None = None
    """Column of the latitude, degrees."""
    diameter_m: str | None = None
    """Column of the diameter, metres; set exactly one of the four size columns."""
    diameter_km: str | None = None
    """Column of the diameter, kilometres."""
    radius_m: str | None = None
    """Column of the radius, metres."""
    radius_km: str | None = None
    """Column of the radius, kilometres."""

    @model_validator(mode="after")
    def _places_and_one_size(self) -> "CatalogueColumnsConfig":
        sizes = [name for name in self.stated if not name.endswith("_deg")]
        if self.stated and (len(self.stated) != 3 or len(sizes) != 1):
            raise ValueError("longitude_deg, latitude_deg and one of diameter_m, diameter_km, radius_m, radius_km")
        return self

    @property
    def stated(self) -> dict[str, str]:
        """The columns that the configuration states: setting name to column name."""
        values = {name: getattr(self, name) for name in CatalogueColumnsConfig.model_fields}
        return {name: value for name, value in values.items() if value is not None}


class ElevationConfig(Section):
    """How an elevation model is used."""

    outside: Outside = "procedural"
    """Ground outside the model: procedural ground with the model's statistics, an error (`refuse`), or the mirrored
    model."""
    site_latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Latitude of the landing site, degrees. If all four site settings are null, it is the middle of the model."""
    site_longitude_deg: Annotated[float, Field(ge=-180, le=360)] | None = None
    """Longitude of the landing site, east positive, degrees."""
    site_column_px: _Place | None = None
    """Column of the landing site, in place of latitude and longitude, pixels from the left edge of the model."""
    site_row_px: _Place | None = None
    """Row of the landing site, pixels from the top edge of the model."""
    height_unit: HeightUnit | None = None
    """Unit of the model's heights; null takes the unit stated in its file, or metres."""
    band: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Band of the heights, from 1; null takes the only band, or the band that the file describes as heights."""
    nodata: Annotated[float, Field(ge=-1e39, le=1e39)] | None = None
    """Stored value of pixels without a height, in addition to the nodata value in the file."""
    crs: (
        Annotated[str, Field(max_length=5000, pattern=r"^(?i:(EPSG|ESRI|IAU|IAU_\d{4}):\d+$|\+proj=|[A-Z_]+\[)")] | None
    ) = None
    """Coordinate reference system of the model, in place of the one in its file: IAU_2015:30135, +proj=..., or WKT."""
    vrt_files: Annotated[list[str], Field(min_length=1, max_length=10_000)] | None = None
    """Files that a VRT model (a GDAL text file that joins rasters) may refer to, as paths relative to its folder."""
    allow_unseen: bool = False
    """Whether to accept a model that has no heights within the ground in view."""
    citation: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """Source and licence of the model, as text. The recipe and the dataset card state it."""
    catalogue_columns: CatalogueColumnsConfig = CatalogueColumnsConfig()
    """Columns of the crater catalogue."""
    rims: RimSource = "measured"
    """Source of position and size of a catalogue's craters: measured in the model where a rim is found there, or
    always taken from the catalogue."""

    @model_validator(mode="after")
    def _one_pair(self) -> "ElevationConfig":
        values = {name: getattr(self, name) for name in SITE_FIELDS}
        stated = tuple(name for name, value in values.items() if value is not None)
        if stated not in ((), SITE_FIELDS[:2], SITE_FIELDS[2:]):
            raise ValueError(f"{' and '.join(SITE_FIELDS[:2])}, or {' and '.join(SITE_FIELDS[2:])}, or none of them")
        return self

    @property
    def site_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude of the site, degrees, if they are stated."""
        return _pair(self.site_latitude_deg, self.site_longitude_deg)

    @property
    def site_px(self) -> tuple[float, float] | None:
        """Column and row of the site, pixels, if they are stated."""
        return _pair(self.site_column_px, self.site_row_px)


def _pair(first: float | None, second: float | None) -> tuple[float, float] | None:
    return None if first is None or second is None else (first, second)


class TerrainConfig(Section):
    """The terrain: procedural ground, or an elevation model with finer details added."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = -45.5
    """Latitude of the site, degrees; an elevation model overrides it."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 177.6
    """Longitude of the site, degrees; an elevation model overrides it."""
    spacing_px: Annotated[float, Field(gt=0, le=LARGEST_SPACING_PX)] = 0.5
    """Vertex spacing at a point of the ground, as a multiple of the smallest pixel size on the ground there."""
    max_vertices: Annotated[int, Field(ge=10_000, le=40_000_000)] = 12_000_000
    """Largest number of ground vertices of one mesh (about 450 bytes of memory per vertex). If the ground needs more,
    each trajectory is rendered with several meshes, each for a range of altitudes; the ground may then have up to ten
    times this number of vertices (70 bytes per vertex while it is generated)."""
    craters: CratersConfig = CratersConfig()
    """The crater population."""
    boulders: BouldersConfig = BouldersConfig()
    """The boulder population."""
    relief: ReliefConfig = ReliefConfig()
    """Relief of the ground, without craters."""
    dem: str | None = None
    """Path of the elevation model that the terrain is based on; null for procedural ground."""
    elevation: ElevationConfig = ElevationConfig()
    """How the elevation model is used."""
    catalogue: str | None = None
    """Path of a CSV or Parquet catalogue of the model's craters, which become labels; null for none."""
