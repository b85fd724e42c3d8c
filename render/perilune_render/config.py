"""Settings of a dataset: the `dataset` section of a configuration file."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_shared.config import Section

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


class Span(Section):
    """A range from which a value is drawn evenly."""

    low: float
    """Least value."""
    high: float
    """Largest value."""

    @model_validator(mode="after")
    def _ordered(self) -> "Span":
        if self.high < self.low:
            raise ValueError(f"high at least low, {self.low}")
        return self


class CameraConfig(Section):
    """The lander's camera, looking along -Z of the body."""

    width_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image width, pixels."""
    height_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image height, pixels."""
    horizontal_fov_deg: Annotated[float, Field(ge=5, le=120)] = 50.0
    """Horizontal field of view, degrees."""


class FlightConfig(Section):
    """The descent: a parabola with smooth Gaussian perturbations."""

    start_altitude_m: Positive = 1500.0
    """Altitude of the first frame above the site, metres."""
    end_altitude_m: Positive = 200.0
    """Altitude of the last frame above the site, metres."""
    downrange_m: NotNegative = 500.0
    """Horizontal distance from the site at the start, metres."""
    azimuth_deg: Span = Span(low=0.0, high=0.0)
    """Direction from the site to the start, clockwise from north, drawn for each descent, degrees."""
    duration_s: Positive = 65.0
    """Time from first to last frame, seconds."""
    position_sigma_m: NotNegative = 8.0
    """Standard deviation of the position about the nominal curve, per axis, metres."""
    attitude_sigma_deg: NotNegative = 0.3
    """Standard deviation of the attitude about level, per axis, degrees."""
    correlation_time_s: Positive = 3.0
    """Time over which perturbations stay alike (squared-exponential kernel), seconds."""

    @model_validator(mode="after")
    def _sinking(self) -> "FlightConfig":
        if self.end_altitude_m >= self.start_altitude_m:
            raise ValueError(f"end_altitude_m below start_altitude_m, {self.start_altitude_m}")
        return self


class SunConfig(Section):
    """Where the Sun stands, drawn for each scene."""

    azimuth_deg: Span = Span(low=0.0, high=360.0)
    """Clockwise from north, degrees."""
    elevation_deg: Span = Span(low=12.0, high=55.0)
    """Above the ground plane, degrees."""


class KindConfig(Section):
    """How many scenes, descents and frames one dataset has, how they are split, and how it flies."""

    n_scenes: Count
    """Terrains."""
    trajectories_per_scene: Count
    """Descents over each terrain."""
    n_frames: Annotated[int, Field(ge=2)]
    """Frames of each descent."""
    split_by: Literal["scene", "trajectory", "frame"]
    """What is never shared between two splits."""
    val_share: Share = 0.1
    """Share of the units in the validation split."""
    test_share: Share = 0.1
    """Share of the units in the test split."""
    flight: FlightConfig = FlightConfig()
    """The descents."""
    sun: SunConfig = SunConfig()
    """The Sun."""

    @model_validator(mode="after")
    def _units(self) -> "KindConfig":
        if self.val_share + self.test_share >= 1:
            raise ValueError("val_share + test_share below 1")
        return self


class CratersConfig(Section):
    """The crater population."""

    surface_age_gyr: Annotated[float, Field(gt=0, le=4.4)] = 3.5
    """Age of the surface, which sets the production of large craters, Gyr."""
    equilibrium_share: Span = Span(low=0.5, high=1.0)
    """Density of small craters over Trask's equilibrium, drawn for each scene."""
    min_diameter_spacings: Annotated[float, Field(ge=2)] = 3.0
    """Smallest crater over the local vertex spacing."""
    max_diameter_m: Positive = 800.0
    """Largest crater, metres."""


class BouldersConfig(Section):
    """The boulder population."""

    density: NotNegative = 1.0
    """Times the published size-frequency law."""
    min_diameter_spacings: Annotated[float, Field(ge=0.5)] = 1.5
    """Smallest boulder over the local vertex spacing."""
    max_diameter_m: Positive = 5.0
    """Largest boulder, metres."""
    n_shapes: Annotated[int, Field(ge=1, le=100)] = 12
    """Different rocks in a scene."""
    clustered_share: Share = 0.6
    """Share of the boulders that lie around young craters."""


class ReliefConfig(Section):
    """Self-affine relief."""

    hurst_exponent: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """How slopes fall with wavelength, L^(H-1)."""
    rms_slope_deg: Annotated[float, Field(ge=0, le=30)] = 5.0
    """Root mean square slope of all waves down to a metre, without craters, degrees (mare about 3, highland 7)."""
    longest_wavelength_m: Positive = 1600.0
    """Longest wave, metres."""


class TerrainConfig(Section):
    """The ground."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)] = -45.5
    """Latitude of the site, degrees."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 177.6
    """Longitude of the site, degrees."""
    spacing_px: Annotated[float, Field(gt=0, le=4)] = 0.75
    """Vertex spacing over the smallest ground pixel from which a place is seen."""
    max_vertices: Annotated[int, Field(ge=10_000, le=20_000_000)] = 4_000_000
    """Most vertices of the height field; a wider spacing is taken where spacing_px would need more."""
    craters: CratersConfig = CratersConfig()
    """Craters."""
    boulders: BouldersConfig = BouldersConfig()
    """Boulders."""
    relief: ReliefConfig = ReliefConfig()
    """Relief."""
    dem: str | None = None
    """A GeoTIFF elevation model as the base, or null."""


class LightConfig(Section):
    """How the ground reflects."""

    photometry: Literal["hapke_highland", "hapke_mare", "lommel_seeliger", "lambert"] = "hapke_highland"
    """Reflectance law and parameter set."""
    sun_angular_diameter_deg: Annotated[float, Field(ge=0, le=5)] = 0.533
    """The Sun's disc, degrees."""
    albedo_variation: NotNegative = 1.0
    """Strength of bright young ejecta and of albedo patches; 0 for an even ground."""


class SensorConfig(Section):
    """From radiance factor to grey values (EMVA 1288)."""

    full_well_e: Positive = 30_000.0
    """Electrons at saturation."""
    read_noise_e: NotNegative = 15.0
    """Standard deviation of the dark signal, electrons."""
    psf_sigma_px: NotNegative = 0.5
    """Standard deviation of the Gaussian point spread, pixels."""
    exposure_percentile: Annotated[float, Field(gt=0, le=100)] = 99.0
    """Automatic exposure puts this percentile of a frame at exposure_level."""
    exposure_level: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Share of the full well."""


class RenderConfig(Section):
    """How Blender renders."""

    samples: Annotated[int, Field(ge=1, le=4096)] = 4
    """Camera rays per pixel."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads; 0 takes every core."""
    exr: bool = False
    """Whether to keep an EXR (radiance factor, depth, normals, crater index) beside each PNG."""


class LabelsConfig(Section):
    """Which craters become labels: the paper's rule."""

    min_radius_px: Positive = 2.0
    """Least sqrt(a b), pixels."""
    max_radius_px: Positive = 50.0
    """Largest sqrt(a b), pixels."""


class DatasetConfig(Section):
    """One preset's two datasets."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """From which every random stream is derived."""
    camera: CameraConfig = CameraConfig()
    """Camera."""
    terrain: TerrainConfig = TerrainConfig()
    """Ground."""
    light: LightConfig = LightConfig()
    """Reflectance and Sun's disc."""
    sensor: SensorConfig = SensorConfig()
    """Sensor."""
    labels: LabelsConfig = LabelsConfig()
    """Labels."""
    render: RenderConfig = RenderConfig()
    """Rendering."""
    detect: KindConfig
    """Dataset for crater detection."""
    nav: KindConfig
    """Dataset for navigation."""

    def kind(self, name: str) -> KindConfig:
        """The settings of the dataset `detect` or `nav`."""
        return self.detect if name == "detect" else self.nav
