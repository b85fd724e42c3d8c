"""Settings of a dataset: the `dataset` section of a configuration file."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from perilune_render.config_terrain import TerrainConfig
from perilune_render.config_values import Count, NotNegative, Positive, Share, Span
from perilune_shared.config import Section
from perilune_shared.dataset.selection import default_label_bound_px


class DistortionConfig(Section):
    """Lens distortion of Brown and Conrady, on image coordinates over the focal length, in OpenCV's form."""

    k1: float = 0.0
    """Radial, r^2."""
    k2: float = 0.0
    """Radial, r^4."""
    p1: float = 0.0
    """Tangential."""
    p2: float = 0.0
    """Tangential."""
    k3: float = 0.0
    """Radial, r^6."""


class CameraConfig(Section):
    """The lander's camera, looking along -Z of the body."""

    width_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image width, pixels."""
    height_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image height, pixels."""
    horizontal_fov_deg: Annotated[float, Field(ge=1, le=120)] = 50.0
    """Horizontal field of view of the whole image width without distortion, degrees."""
    focal_length_px: Positive | None = None
    """Focal length over the pixel's width, pixels; null takes it from horizontal_fov_deg."""
    principal_x_px: float | None = None
    """Principal point right of the left edge, pixels; null is the middle."""
    principal_y_px: float | None = None
    """Principal point below the top edge, pixels; null is the middle."""
    distortion: DistortionConfig = DistortionConfig()
    """Lens distortion."""


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
    """Above the ground plane, degrees, above 0 and at most 90."""

    @model_validator(mode="after")
    def _risen(self) -> "SunConfig":
        if not (self.elevation_deg.low > 0 and self.elevation_deg.high <= 90):
            raise ValueError("elevation_deg above 0 (the horizon) and at most 90")
        return self


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


class LightConfig(Section):
    """How the ground reflects, and what lights it."""

    photometry: Literal["hapke_highland", "hapke_mare", "hapke_mean", "lommel_seeliger", "lunar_lambert", "lambert"] = (
        "hapke_highland"
    )
    """Reflectance law and parameter set."""
    sun_angular_diameter_deg: Annotated[float, Field(ge=0, le=5)] = 0.533
    """The Sun's disc, degrees."""
    albedo_variation: NotNegative = 1.0
    """Strength of bright young ejecta, of rays and of albedo patches; 0 for an even ground."""
    bounce: bool = False
    """Whether light that the ground scatters once reaches other ground: shadows are then not quite black."""
    earthshine: bool = False
    """Whether the Earth, where it stands above the horizon, lights the ground too."""


class SensorConfig(Section):
    """From radiance factor to grey values (EMVA 1288)."""

    exposure: Literal["automatic", "fixed"] = "automatic"
    """Automatic puts exposure_percentile of each frame at exposure_level; fixed takes exposure_time_s."""
    exposure_percentile: Annotated[float, Field(gt=0, le=100)] = 99.0
    """Percentile of a frame that automatic exposure looks at."""
    exposure_level: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Share of the largest grey value at which automatic exposure puts it."""
    exposure_time_s: Positive = 0.002
    """Fixed exposure, seconds."""
    longest_exposure_s: Positive = 0.02
    """Longest automatic exposure, seconds."""
    responsivity_e_per_s: Positive = 2e8
    """Electrons per second in a pixel that sees a radiance factor of 1."""
    full_well_e: Positive = 30_000.0
    """Electrons at saturation."""
    gain: Positive = 1.0
    """Over the gain at which the full well is the largest grey value."""
    bits: Annotated[int, Field(ge=8, le=16)] = 8
    """Of a grey value; above 8 the PNG holds 16-bit numbers."""
    black_level_share: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """Offset added before quantisation, share of the largest grey value."""
    read_noise_e: NotNegative = 15.0
    """Standard deviation of the dark signal, electrons."""
    dark_current_e_per_s: NotNegative = 50.0
    """Mean dark current, electrons per second."""
    dark_nonuniformity_e: NotNegative = 3.0
    """Fixed pattern: standard deviation of the pixels' offsets (DSNU), electrons."""
    gain_nonuniformity: Annotated[float, Field(ge=0, le=0.5)] = 0.005
    """Fixed pattern: standard deviation of the pixels' relative response (PRNU)."""
    hot_pixel_share: Share = 2e-5
    """Share of the pixels that are hot."""
    hot_pixel_e: NotNegative = 6_000.0
    """Mean of the hot pixels' exponentially distributed extra signal in an exposure of 2 ms, electrons."""
    psf_sigma_px: NotNegative = 0.45
    """Standard deviation of the point spread, a discrete Gaussian over the pixels; 0 for none."""
    motion_blur: bool = True
    """Whether the camera's velocity during the exposure blurs the frame."""

    @model_validator(mode="after")
    def _above_black(self) -> "SensorConfig":
        if self.exposure_level <= self.black_level_share:
            raise ValueError(f"exposure_level above black_level_share, {self.black_level_share}")
        return self


class RenderConfig(Section):
    """How Blender renders."""

    samples: Annotated[int, Field(ge=1, le=4096)] = 4
    """Camera rays per pixel."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads; 0 takes every core."""
    exr: bool = False
    """Whether to keep an EXR (radiance factor, depth, normals, crater index) beside each PNG."""
    cache_gib: NotNegative = 4.0
    """Most that grown scenes may occupy in the cache folder, GiB; 0 keeps none."""


class LabelsConfig(Section):
    """Which craters become labels: the paper's rule."""

    min_radius_px: Positive = 2.0
    """Least sqrt(a b), pixels."""
    max_radius_px: Positive | None = None
    """Largest sqrt(a b), pixels; null is 50, and in images wider than 256 px width x 50 / 256."""

    @model_validator(mode="after")
    def _ordered(self) -> "LabelsConfig":
        largest_px = self.max_radius_px or default_label_bound_px(1)
        if self.min_radius_px >= largest_px:
            raise ValueError(f"min_radius_px below max_radius_px, {largest_px}")
        return self

    def bounds_px(self, width_px: int) -> tuple[float, float]:
        """Least and largest sqrt(a b) of a label in images of a width, pixels."""
        return self.min_radius_px, self.max_radius_px or default_label_bound_px(width_px)


_GROUND_FIELDS = ("start_altitude_m", "end_altitude_m", "downrange_m")
"""Of the flight: what the extent and spacing of the ground follow from, beside the sizes of the perturbations."""
_SPREAD_FIELDS = ("position_sigma_m", "attitude_sigma_deg")


class DatasetConfig(Section):
    """One preset's two datasets."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,59}$")] = "unnamed"
    """Name of the dataset; terrain, Sun and splits follow from it and the seed. Every preset has its own."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """From which, with the name, every random stream is derived."""
    shared_terrain: bool = False
    """Whether both kinds fly over the same scenes, as in the paper; else each kind has its own."""
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

    @model_validator(mode="after")
    def _one_ground(self) -> "DatasetConfig":
        if self.shared_terrain and self.detect.sun != self.nav.sun:
            raise ValueError("detect.sun equal to nav.sun, since shared_terrain is true")
        for field in _GROUND_FIELDS if self.shared_terrain else ():
            if getattr(self.detect.flight, field) != getattr(self.nav.flight, field):
                raise ValueError(f"detect.flight.{field} equal to nav.flight.{field}, since shared_terrain is true")
        return self

    def kind(self, name: str) -> KindConfig:
        """The settings of the dataset `detect` or `nav`."""
        return self.detect if name == "detect" else self.nav

    def ground_flight(self, kind: str) -> FlightConfig:
        """The flight for which the ground of `detect` or `nav` is made: with `shared_terrain` it covers both."""
        if not self.shared_terrain:
            return self.kind(kind).flight
        first, second = self.detect.flight, self.nav.flight
        widest = {name: max(getattr(first, name), getattr(second, name)) for name in _SPREAD_FIELDS}
        return first.model_copy(update=widest)
