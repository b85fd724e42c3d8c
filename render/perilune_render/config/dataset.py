"""Settings of a dataset: the `dataset` section of a configuration file."""

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from perilune_render.config.cameras import CameraConfig, CameraName, MountedCameraConfig
from perilune_render.config.derived import CounterfactualConfig, SurveyConfig
from perilune_render.config.outputs import FlashLidarConfig, HazardConfig
from perilune_render.config.scene import HIGHEST_M, SceneConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_render.config.values import (
    Altitude,
    Count,
    Deviation,
    Electrons,
    Exposure,
    Pixels,
    Seconds,
    Share,
    Span,
    Within,
)
from perilune_shared.config.resolve import Section
from perilune_shared.dataset.names import SplitUnit
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_shared.labels.thresholds import default_label_bound_px

MAX_TRAJECTORIES, MAX_FRAMES = 200_000, 10_000_000
"""Largest numbers of trajectories and frames of a dataset. They are limited because all trajectories are planned before
the first frame is rendered."""
MAX_MEASUREMENTS = 10_000_000
"""Largest number of measurements of one instrument along one trajectory."""
MAX_OFF_NADIR_DEG = 80.0
"""Largest tilt of the body from a level attitude, degrees. The axis of a camera along -Z_B then still meets the
ground."""
_MIN_LIMIT_SIGMAS = 3.0
"""Smallest `max_perturbation_mps2`, in standard deviations of the acceleration on an axis. About half of all drawn
perturbations stay below this limit; the others are drawn again."""


class FlightConfig(Section):
    """The trajectory: a parabola with smooth Gaussian perturbations."""

    start_altitude_m: Altitude = 1500.0
    """Altitude of the first frame above the site, metres."""
    end_altitude_m: Altitude = 200.0
    """Altitude of the last frame above the site, metres."""
    downrange_m: Annotated[float, Field(ge=0, le=1e6)] = 500.0
    """Horizontal distance from the site at the start, metres."""
    azimuth_deg: Annotated[Span, Within(-720, 720)] = Span(low=0.0, high=0.0)
    """Direction from the site to the start, clockwise from north, drawn for each trajectory, degrees."""
    duration_s: Seconds = 65.0
    """Time from the first frame to the last, seconds."""
    position_sigma_m: Deviation = 8.0
    """Standard deviation of the position from the nominal parabola, per axis, metres."""
    attitude_sigma_deg: Annotated[float, Field(ge=0, le=90)] = 0.3
    """Standard deviation of the attitude from the nominal attitude, per axis, degrees. The nominal attitude is level,
    or tilted by off_nadir_deg."""
    off_nadir_deg: Annotated[Span, Within(0, MAX_OFF_NADIR_DEG)] = Span(low=0.0, high=0.0)
    """Angle between the camera's axis and straight down, drawn for each trajectory, degrees. Above 0, the ground is
    curved and extends to the horizon, as with dataset.scene.horizon."""
    off_nadir_azimuth_deg: Annotated[Span, Within(-720, 720)] = Span(low=0.0, high=0.0)
    """Direction in which the camera is tilted, clockwise from the direction of flight, drawn for each trajectory,
    degrees. At 0 (pitched about the cross-track axis) it looks ahead, at 180 it looks back."""
    correlation_time_s: Seconds = 3.0
    """Correlation time of the perturbations (squared-exponential kernel), seconds."""
    attitude_correlation_time_s: Seconds | None = None
    """Correlation time of the perturbation of the attitude, seconds; null takes correlation_time_s."""
    max_perturbation_mps2: Annotated[float, Field(gt=0, le=1000)] | None = None
    """Largest acceleration by the perturbation of the position, metres per second squared; null for no limit."""

    @model_validator(mode="after")
    def _end_below_start(self) -> "FlightConfig":
        if self.end_altitude_m >= self.start_altitude_m:
            raise ValueError(f"end_altitude_m below start_altitude_m, {self.start_altitude_m}")
        return self

    @model_validator(mode="after")
    def _limit_can_be_kept(self) -> "FlightConfig":
        least = _MIN_LIMIT_SIGMAS * 3**0.5 * self.position_sigma_m / self.correlation_time_s**2
        if self.max_perturbation_mps2 is not None and self.max_perturbation_mps2 < least:
            raise ValueError(
                f"max_perturbation_mps2 at least {least:.3g}, {_MIN_LIMIT_SIGMAS:g} standard deviations of the "
                f"acceleration on each axis, sqrt(3) position_sigma_m / correlation_time_s^2"
            )
        return self

    @model_validator(mode="after")
    def _low_enough_for_a_horizon(self) -> "FlightConfig":
        highest = HIGHEST_M - 3 * self.position_sigma_m
        if self.is_oblique and self.start_altitude_m > highest:
            raise ValueError(f"start_altitude_m of at most {highest:g}, since off_nadir_deg is above 0")
        return self

    @property
    def is_oblique(self) -> bool:
        """Whether trajectories may be tilted, so that frames may show the horizon."""
        return self.off_nadir_deg.high > 0

    @property
    def attitude_correlation_s(self) -> float:
        """Correlation time of the perturbation of the attitude, seconds."""
        return self.attitude_correlation_time_s or self.correlation_time_s


class InstrumentsConfig(Section):
    """Simulated measurements along each trajectory.

    They are in the tables `inertial`, `ranges`, `star_tracker` and `doppler_lidar`.
    """

    inertial_grades: tuple[InertialGrade, ...] = ()
    """Grades of inertial measurement units (gyroscopes and accelerometers) to simulate."""
    inertial_rate_hz: Annotated[float, Field(ge=1, le=1000)] = 100.0
    """Inertial measurements per second."""
    range_rate_hz: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Measurements of the laser altimeter per second; 0 for no altimeter. With given poses, any other value gives one
    measurement at the time of each frame."""
    range_sigma_m: Deviation = 0.2
    """Standard deviation of a range at distance 0, metres."""
    range_sigma_share: Share = 0.0005
    """Standard deviation that is added in proportion to the range, share of the range."""
    star_tracker_rate_hz: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Attitudes of a star tracker per second; 0 for no star tracker."""
    star_tracker_sigma_arcsec: tuple[Deviation, Deviation, Deviation] = (10.0, 10.0, 60.0)
    """Standard deviations of an attitude about X_B, Y_B and Z_B, seconds of arc. The tracker looks along Z_B, and is
    least precise about this axis."""
    star_tracker_outages_s: tuple[Annotated[Span, Within(0, 1e6)], ...] = ()
    """Times without attitudes, from `low` to `high` seconds after the first frame."""
    doppler_rate_hz: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Measurements of each beam of a Doppler lidar per second; 0 for no Doppler lidar."""
    doppler_beams: Annotated[int, Field(ge=1, le=16)] = 3
    """Number of beams of the Doppler lidar."""
    doppler_beam_angle_deg: Annotated[float, Field(ge=0, le=60)] = 22.5
    """Angle between each beam and -Z_B, degrees."""
    doppler_speed_sigma_mps: Deviation = 0.02
    """Standard deviation of a speed along a beam, metres per second."""
    doppler_range_sigma_m: Deviation = 2.0
    """Standard deviation of a range along a beam, metres."""

    @property
    def largest_rate_hz(self) -> float:
        """Largest number of measurements of one instrument per second."""
        inertial_hz = self.inertial_rate_hz if self.inertial_grades else 0.0
        beams_hz = self.doppler_rate_hz * self.doppler_beams
        return max(inertial_hz, self.range_rate_hz, self.star_tracker_rate_hz, beams_hz)


class SunConfig(Section):
    """Direction of the Sun, drawn for each scene."""

    azimuth_deg: Annotated[Span, Within(-720, 720)] = Span(low=0.0, high=360.0)
    """Azimuth, clockwise from north, degrees."""
    elevation_deg: Annotated[Span, Within(0, 90)] = Span(low=12.0, high=55.0)
    """Elevation above the ground plane, above 0 and at most 90, degrees."""

    @model_validator(mode="after")
    def _sun_above_horizon(self) -> "SunConfig":
        if not (self.elevation_deg.low > 0 and self.elevation_deg.high <= 90):
            raise ValueError("elevation_deg above 0 (the horizon) and at most 90")
        return self


class KindConfig(Section):
    """Settings of one dataset: numbers of scenes, trajectories and frames, split, flight and Sun."""

    n_scenes: Count
    """Number of scenes, each with its own terrain."""
    trajectories_per_scene: Count
    """Number of trajectories over each scene's terrain."""
    n_frames: Annotated[int, Field(ge=2, le=1_000_000)]
    """Number of frames of each trajectory."""
    split_by: SplitUnit
    """Unit of the split: each scene, trajectory or frame belongs to one split as a whole."""
    val_share: Share = 0.1
    """Share of scenes, trajectories or frames (`split_by`) in the validation split."""
    test_share: Share = 0.1
    """Share of scenes, trajectories or frames (`split_by`) in the test split; 1 puts all of them into it."""
    flight: FlightConfig = FlightConfig()
    """Shape and perturbations of the trajectories."""
    sun: SunConfig = SunConfig()
    """Direction of the Sun."""
    instruments: InstrumentsConfig = InstrumentsConfig()
    """Simulated inertial and range measurements."""

    @model_validator(mode="after")
    def _fits(self) -> "KindConfig":
        trajectories = self.n_scenes * self.trajectories_per_scene
        if trajectories > MAX_TRAJECTORIES:
            product = f"n_scenes x trajectories_per_scene, which is {trajectories}"
            raise ValueError(f"{product}, at most {MAX_TRAJECTORIES}: lower one of them")
        frames = trajectories * self.n_frames
        if frames > MAX_FRAMES:
            product = f"n_scenes x trajectories_per_scene x n_frames, which is {frames}"
            raise ValueError(f"{product}, at most {MAX_FRAMES}: lower one of them")
        measurements = self.instruments.largest_rate_hz * self.flight.duration_s
        if measurements > MAX_MEASUREMENTS:
            raise ValueError(
                f"rate x flight.duration_s, which is {measurements:.3g} measurements of one instrument, at most "
                f"{MAX_MEASUREMENTS}: lower the rates of instruments, or flight.duration_s"
            )
        return self

    @model_validator(mode="after")
    def _shares_below_one(self) -> "KindConfig":
        if self.val_share + self.test_share >= 1 and (self.val_share, self.test_share) != (0, 1):
            raise ValueError("val_share + test_share below 1, or test_share 1 and val_share 0 for a test set")
        return self


class LightConfig(Section):
    """Reflectance of the ground, and light sources."""

    photometry: Literal["hapke_highland", "hapke_mare", "hapke_mean", "lommel_seeliger", "lunar_lambert", "lambert"] = (
        "hapke_highland"
    )
    """Reflectance law of the ground, with its parameters."""
    sun_angular_diameter_deg: Annotated[float, Field(ge=0, le=5)] = 0.533
    """Angular diameter of the Sun, degrees."""
    albedo_variation: Annotated[float, Field(ge=0, le=10)] = 1.0
    """Strength of bright ejecta, rays and albedo patches; 0 for uniform albedo."""
    bounce: bool = False
    """Whether ground also receives light that other ground has scattered once. Without bounce and earthshine, shadows
    are black."""
    earthshine: bool = False
    """Whether the Earth, if it is above the horizon, also lights the ground."""


class SensorConfig(Section):
    """Sensor model, from radiance factor to grey values (EMVA 1288)."""

    exposure: Literal["automatic", "fixed"] = "automatic"
    """Automatic exposure brings exposure_percentile of each frame to exposure_level; fixed uses exposure_time_s."""
    exposure_percentile: Annotated[float, Field(gt=0, le=100)] = 99.0
    """Percentile of the frame's radiance factor that automatic exposure uses."""
    exposure_level: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Grey value to which automatic exposure brings exposure_percentile, share of the largest grey value."""
    exposure_time_s: Exposure = 0.002
    """Exposure time if exposure is fixed, seconds."""
    longest_exposure_s: Exposure = 0.02
    """Longest exposure time if exposure is automatic, seconds."""
    responsivity_e_per_s: Annotated[float, Field(gt=0, le=1e15)] = 2e8
    """Electrons per second in a pixel at radiance factor 1."""
    full_well_e: Annotated[float, Field(gt=0, le=1e9)] = 30_000.0
    """Full-well capacity (saturation), electrons."""
    gain: Annotated[float, Field(gt=0, le=10_000)] = 1.0
    """Gain, relative to the gain at which the full well is the largest grey value."""
    bits: Annotated[int, Field(ge=8, le=16)] = 8
    """Bits of a grey value; above 8 the PNG has 16 bits."""
    black_level_share: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """Offset added before quantisation, share of the largest grey value."""
    read_noise_e: Electrons = 15.0
    """Read noise: standard deviation of the dark signal without dark current, electrons."""
    dark_current_e_per_s: Electrons = 50.0
    """Mean dark current, electrons per second."""
    dark_nonuniformity_e: Electrons = 3.0
    """Standard deviation of the pixels' fixed offsets (DSNU), electrons."""
    gain_nonuniformity: Annotated[float, Field(ge=0, le=0.5)] = 0.005
    """Standard deviation of the pixels' fixed relative response (PRNU)."""
    hot_pixel_share: Share = 2e-5
    """Share of hot pixels, which have an extra dark signal."""
    hot_pixel_e: Electrons = 6_000.0
    """Mean extra signal of the hot pixels in a 2 ms exposure (exponential distribution), electrons."""
    psf_sigma_px: Annotated[float, Field(ge=0, le=50)] = 0.45
    """Standard deviation of the point spread function, a discrete Gaussian, pixels; 0 for none."""
    motion_blur: bool = True
    """Whether the camera's motion during the exposure blurs the frame."""
    blur_poses: Annotated[int, Field(ge=1, le=256)] = 1
    """Number of poses during the exposure that are rendered and averaged. With 1, a single rendering is blurred along
    the motion of each pixel. More poses give a more accurate blur, but each pose needs a rendering."""
    row_time_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Time between the exposures of two neighbouring rows (rolling shutter), seconds; 0 exposes all rows at once."""

    @model_validator(mode="after")
    def _above_black(self) -> "SensorConfig":
        if self.exposure_level <= self.black_level_share:
            raise ValueError(f"exposure_level above black_level_share, {self.black_level_share}")
        return self


class RenderConfig(Section):
    """Settings of the renderer."""

    engine: Literal["cycles", "heightfield"] = "cycles"
    """Rendering engine: `cycles` is Blender's. `heightfield` casts rays at the height field; it is faster, but renders
    no bounce and no earthshine."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Processor of the engine `heightfield`: cpu, cuda (a GPU of NVIDIA), or auto (a GPU if there is one). Frames of
    both agree within 1e-4 outside the edges of shadows, but not to the byte."""
    cycles_device: Literal["cpu", "cuda", "optix", "hip", "oneapi", "metal"] = "cpu"
    """Processor of the engine `cycles`: cpu, or a GPU by one of Cycles's interfaces. Each worker process uses one GPU.
    Frames of a GPU are not equal to the byte."""
    samples: Annotated[int, Field(ge=1, le=4096)] = 4
    """Camera rays per pixel."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Number of threads; 0 uses all cores."""
    exr: bool = False
    """Whether to write an EXR (radiance factor, depth, normals, sunlit mask, crater index) for each PNG."""
    cache_gib: Annotated[float, Field(ge=0, le=100_000)] = 4.0
    """Size limit of the cache of generated scenes, GiB; 0 disables the cache."""

    @model_validator(mode="after")
    def _device_of_engine(self) -> "RenderConfig":
        if self.device != "cpu" and self.engine != "heightfield":
            raise ValueError("device cpu, or engine heightfield")
        if self.cycles_device != "cpu" and self.engine != "cycles":
            raise ValueError("cycles_device cpu, or engine cycles")
        return self


class LabelsConfig(Section):
    """Limits on the radius of labels.

    A crater within these limits is labelled if its centre is in the frame.
    """

    min_radius_px: Pixels = 2.0
    """Smallest radius of a label, sqrt(a b) of its ellipse, pixels."""
    max_radius_px: Pixels | None = None
    """Largest radius of a label, pixels; null is 50, or width x 50 / 256 in images wider than 256 px."""

    @model_validator(mode="after")
    def _ordered(self) -> "LabelsConfig":
        largest_px = self.max_radius_px or default_label_bound_px(1)
        if self.min_radius_px >= largest_px:
            raise ValueError(f"min_radius_px below max_radius_px, {largest_px}")
        return self

    def bounds_px(self, width_px: int) -> tuple[float, float]:
        """Smallest and largest radius sqrt(a b) of a label in images of this width, pixels."""
        return self.min_radius_px, self.max_radius_px or default_label_bound_px(width_px)


_GROUND_FIELDS = ("start_altitude_m", "end_altitude_m", "downrange_m")
"""Flight settings that must agree if both kinds share terrain, since they determine its extent and vertex spacing."""
_SPREAD_FIELDS = ("position_sigma_m", "attitude_sigma_deg")
"""Flight settings for which shared terrain uses the larger of both kinds' values."""


class DatasetConfig(Section):
    """Settings of a preset's two datasets."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,59}$")] = "unnamed"
    """Name, unique to the preset; terrain, Sun and splits are derived from the name and the seed."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """Random seed; with the name it determines every random stream."""
    shared_terrain: bool = False
    """Whether the datasets `detect` and `nav` use the same scenes, as in the paper; if not, each has its own."""
    camera: CameraConfig = CameraConfig()
    """The lander's single camera."""
    cameras: dict[CameraName, MountedCameraConfig] = Field(default_factory=dict)
    """Several cameras on the body, by name, in place of `camera`. Each has its own settings and a `mounting`."""
    terrain: TerrainConfig = TerrainConfig()
    """Ground: craters, boulders, relief, elevation model."""
    light: LightConfig = LightConfig()
    """Reflectance of the ground, and light sources."""
    sensor: SensorConfig = SensorConfig()
    """Sensor model of the camera."""
    labels: LabelsConfig = LabelsConfig()
    """Limits on the radius of crater labels."""
    render: RenderConfig = RenderConfig()
    """Rendering engine and its settings."""
    detect: KindConfig
    """Dataset for crater detection."""
    nav: KindConfig
    """Dataset for navigation."""
    hazard: HazardConfig | None = None
    """Hazard map of each scene; null for none."""
    flash_lidar: FlashLidarConfig | None = None
    """Flash lidar beside the camera; null for none."""
    scene: SceneConfig | None = None
    """Scene of commands with given poses, such as `perilune-render frames`; it replaces drawn scenes and descents."""
    survey: SurveyConfig | None = None
    """Images from orbit in place of the descents, over the same ground; `perilune-render survey` sets it."""
    counterfactual: CounterfactualConfig | None = None
    """Craters removed or made shallower, or another Sun; `perilune-render counterfactual` sets it."""

    @field_validator("cameras")
    @classmethod
    def _sorted_by_name(cls, cameras: dict[str, MountedCameraConfig]) -> dict[str, MountedCameraConfig]:
        return dict(sorted(cameras.items()))

    @model_validator(mode="after")
    def _same_ground(self) -> "DatasetConfig":
        if self.shared_terrain and self.detect.sun != self.nav.sun:
            raise ValueError("detect.sun equal to nav.sun, since shared_terrain is true")
        for field in _GROUND_FIELDS if self.shared_terrain else ():
            if getattr(self.detect.flight, field) != getattr(self.nav.flight, field):
                raise ValueError(f"detect.flight.{field} equal to nav.flight.{field}, since shared_terrain is true")
        return self

    @model_validator(mode="after")
    def _channels_have_a_file(self) -> "DatasetConfig":
        if self.hazard is not None and self.hazard.frame_channels and not self.render.exr:
            raise ValueError("render.exr true, since hazard.frame_channels is true")
        return self

    def kind(self, name: str) -> KindConfig:
        """Settings of the dataset `detect` or `nav`."""
        return self.detect if name == "detect" else self.nav

    def removed_from(self, scene_seed: int) -> tuple[int, ...]:
        """Ids of the craters that are removed or made shallower in the scene with this random seed."""
        return self.counterfactual.removed.get(scene_seed, ()) if self.counterfactual is not None else ()

    @property
    def depth_share(self) -> float:
        """Share of the depth that the craters of `removed_from` keep; 0 if they are removed."""
        return self.counterfactual.depth_share if self.counterfactual is not None else 0.0

    def ground_flight(self, kind: str) -> FlightConfig:
        """Flight settings that determine the ground of `detect` or `nav`.

        With `shared_terrain`, each standard deviation is the larger of the two kinds' values, and the tilt is the wider
        of their tilts.
        """
        if not self.shared_terrain:
            return self.kind(kind).flight
        first, second = self.detect.flight, self.nav.flight
        widest = {name: max(getattr(first, name), getattr(second, name)) for name in _SPREAD_FIELDS}
        tilt = max(first.off_nadir_deg, second.off_nadir_deg, key=lambda span: span.high)
        return first.model_copy(update={**widest, "off_nadir_deg": tilt})
