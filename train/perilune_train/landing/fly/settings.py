"""Read camera.yaml and prior.yaml, the knowledge before a descent; both are untrusted input."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator

from perilune_shared.config.errors import user_error_of
from perilune_shared.config.resolve import Section
from perilune_shared.config.yaml_text import parse_yaml
from perilune_shared.dataset.metadata import CameraRecord, fields_of
from perilune_shared.errors import UserError
from perilune_shared.geometry.calibration import Calibration, read_camera_file
from perilune_shared.geometry.camera import NO_DISTORTION, ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.geometry.inertial_grades import GRADES, InertialErrors, InertialGrade
from perilune_shared.storage.tables.catalogues import METRES
from perilune_train.landing.filter.lander import RANGE_SIGMA_M, RELIEF_M, LidarErrors
from perilune_train.landing.filter.propagate import COAST_DEGPS, COAST_MPS2, InertialNoise, start_sigmas
from perilune_train.landing.filter.state import CameraErrors, State
from perilune_train.landing.fly.catalogue import CatalogueUse

_LARGEST_FILE_BYTES = 100_000
_UNIT_TOLERANCE = 1e-3
_Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
_Deviation = Annotated[float, Field(gt=0, le=1e5)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Positive = Annotated[float, Field(gt=0, le=1e6)]
CatalogueColumn = Literal["longitude_deg", "latitude_deg", "diameter_m", "diameter_km", "radius_m", "radius_km"]
"""What a column of a catalogue contains."""


class UnitErrors(Section):
    """Errors of an inertial unit, standard deviations on each axis, as in `InertialErrors`."""

    gyro_bias_deg_per_h: _Positive
    """Bias of the angular rate at the start, degrees per hour."""
    gyro_bias_walk_deg_per_h: _Positive
    """Random walk of the bias of the angular rate in one hour, degrees per hour."""
    angular_random_walk_deg: _Positive
    """White noise of the angular rate: angle after integration over one hour, degrees."""
    accelerometer_bias_mg: _Positive
    """Bias of the specific force at the start, thousandths of standard gravity."""
    accelerometer_bias_walk_mg: _Positive
    """Random walk of the bias of the specific force in one hour, thousandths of standard gravity."""
    velocity_random_walk_mps: _Positive
    """White noise of the specific force: velocity after integration over one hour, metres per second."""


class FlightPrior(Section):
    """prior.yaml: the expected state at the first frame and the errors of all measurements."""

    position_m: tuple[_Coordinate, _Coordinate, _Coordinate]
    """Expected position of the camera, metres, O_L."""
    velocity_mps: tuple[_Coordinate, _Coordinate, _Coordinate]
    """Expected velocity, metres per second, O_L."""
    rotation_wxyz: tuple[_Coordinate, _Coordinate, _Coordinate, _Coordinate]
    """Expected rotation_camera_from_site, unit quaternion."""
    position_sigma_m: _Deviation
    """Standard deviation of the position on each axis, metres."""
    velocity_sigma_mps: _Deviation
    """Standard deviation of the velocity on each axis, metres per second."""
    attitude_sigma_deg: Annotated[float, Field(gt=0, le=180)]
    """Standard deviation of the attitude about each axis, degrees."""
    inertial: InertialGrade | UnitErrors = "tactical"
    """Grade of the inertial unit, or the errors of the unit."""
    range_sigma_m: _Deviation = RANGE_SIGMA_M
    """Standard deviation of a range of the laser altimeter, metres."""
    relief_m: _Deviation = RELIEF_M
    """Standard deviation of the ground's height relative to the nearest craters, metres."""
    star_tracker_sigma_arcsec: tuple[_Positive, _Positive, _Positive] = (10.0, 10.0, 60.0)
    """Standard deviations of the star tracker about the body's axes, seconds of arc."""
    doppler_speed_sigma_mps: _Deviation = 0.02
    """Standard deviation of a speed along a beam of the Doppler lidar, metres per second."""
    doppler_range_sigma_m: _Deviation = 2.0
    """Standard deviation of a range along a beam of the Doppler lidar, metres."""
    camera_mounting_sigma_deg: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Standard deviation of the camera's mounting about each axis, degrees."""
    camera_time_sigma_s: Annotated[float, Field(ge=0, le=1)] = 0.05
    """Standard deviation of the constant difference between the exposure and the time of a frame, seconds."""
    coast_acceleration_sigma_mps2: _Positive = COAST_MPS2
    """Standard deviation of the acceleration while inertial measurements are missing, metres per second^2."""
    coast_rate_sigma_degps: _Positive = COAST_DEGPS
    """Standard deviation of the angular rate while inertial measurements are missing, degrees per second."""
    catalogue_position_sigma_m: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Standard deviation of a crater's position in the catalogue on each axis, metres."""
    catalogue_diameter_sigma_share: _Share = 0.03
    """Standard deviation of a crater's diameter in the catalogue, divided by the diameter."""
    sun_elevation_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Elevation of the Sun above the site, degrees. Under a high Sun, the errors of detected centres are larger; if the
    elevation is absent, a high Sun is assumed."""
    site_latitude_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    """Latitude of the origin of O_L, degrees, for a catalogue in latitude and longitude."""
    site_longitude_deg: Annotated[float, Field(ge=-180, le=360)] | None = None
    """Longitude of the origin of O_L, east positive, degrees."""
    catalogue_columns: dict[CatalogueColumn, str] = Field(default_factory=dict)
    """Column names of a catalogue in latitude and longitude; if empty, they are recognised."""

    @model_validator(mode="after")
    def _unit_quaternion(self) -> "FlightPrior":
        if abs(np.linalg.norm(self.rotation_wxyz) - 1) > _UNIT_TOLERANCE:
            raise ValueError("rotation_wxyz should be a unit quaternion")
        return self

    @model_validator(mode="after")
    def _site_and_columns(self) -> "FlightPrior":
        if (self.site_latitude_deg is None) != (self.site_longitude_deg is None):
            raise ValueError("site_latitude_deg and site_longitude_deg, or neither")
        sizes = set(self.catalogue_columns) & set(METRES)
        if self.catalogue_columns and (len(self.catalogue_columns) != 3 or len(sizes) != 1):
            raise ValueError("catalogue_columns with longitude_deg, latitude_deg and one size")
        return self

    @property
    def catalogue_use(self) -> CatalogueUse:
        """How the catalogue is read."""
        latitude, longitude = self.site_latitude_deg, self.site_longitude_deg
        site = None if latitude is None or longitude is None else (latitude, longitude)
        sigmas = self.catalogue_position_sigma_m, self.catalogue_diameter_sigma_share
        return CatalogueUse(*sigmas, site, {str(name): column for name, column in self.catalogue_columns.items()})

    @property
    def unit(self) -> InertialErrors:
        """Errors of the inertial unit."""
        return GRADES[self.inertial] if isinstance(self.inertial, str) else InertialErrors(**self.inertial.model_dump())

    def state(self, rotation_camera_from_body: Array) -> State:
        """The filter's state at the first frame."""
        camera_from_site = matrix_from_quaternion(np.array(self.rotation_wxyz))
        return State.starting(
            np.array(self.position_m),
            np.array(self.velocity_mps),
            camera_from_site.T @ rotation_camera_from_body,
            start_sigmas(self.position_sigma_m, self.velocity_sigma_mps, self.attitude_sigma_deg, self.unit),
            self.relief_m,
            CameraErrors(self.sun_elevation_deg, self.camera_mounting_sigma_deg, self.camera_time_sigma_s),
        )

    @property
    def noise(self) -> InertialNoise:
        """Noise of the inertial unit, and of the motion while its measurements are missing."""
        coast = self.coast_acceleration_sigma_mps2, np.radians(self.coast_rate_sigma_degps)
        return replace(InertialNoise.of(self.unit), coast_mps2=coast[0], coast_radps=float(coast[1]))

    @property
    def star_tracker_sigmas_rad(self) -> Array:
        """Standard deviations (3,) of the star tracker about the body's axes, radians."""
        return np.radians(np.array(self.star_tracker_sigma_arcsec) / 3600)

    @property
    def lidar_errors(self) -> LidarErrors:
        """Standard deviations of the Doppler lidar, for one measurement of each beam per second."""
        return LidarErrors(self.doppler_speed_sigma_mps, self.doppler_range_sigma_m, 1.0)


def read_camera(path: Path) -> CameraRecord:
    """Read camera.yaml, or a calibration file of OpenCV, ROS, Kalibr or EuRoC.

    camera.yaml has the fields of `camera` in dataset.json. Distortion and mounting may be absent. Raises UserError on a
    missing file, a wrong value, or a camera that is not at the body's origin.
    """
    content = read_camera_file(path)
    if isinstance(content, Calibration):
        rotation, content = content.rotation_camera_from_body, _fields_of(content)
        if rotation is not None:
            # Calibration files give few digits: make the matrix orthogonal again.
            u, _, v = np.linalg.svd(rotation)
            content["rotation_camera_from_body"] = (
                u @ v if np.abs(u @ v - rotation).max() < 1e-3 else rotation
            ).tolist()
    rows = ROTATION_CAMERA_FROM_BODY.tolist()
    defaults = {"distortion": NO_DISTORTION, "rotation_camera_from_body": rows, "position_in_body_m": [0.0, 0.0, 0.0]}
    camera = _validated(CameraRecord, defaults | content, path, "camera")
    if any(camera.position_in_body_m):
        expected = (
            "[0, 0, 0]: the filter assumes that the camera is at the inertial unit; set a negligible distance to 0"
        )
        raise UserError(path, "camera.position_in_body_m", list(camera.position_in_body_m), expected)
    if camera.model != "pinhole":
        raise UserError(path, "camera.model", camera.model, "pinhole: the filter uses no lens models")
    if camera.intrinsics().folds_back():
        raise UserError(path, "camera.distortion", list(camera.distortion), "a distortion that does not fold back")
    return camera


def _fields_of(calibration: Calibration) -> dict[str, Any]:
    return fields_of(calibration.camera) | {"position_in_body_m": list(calibration.position_in_body_m)}


def read_prior(path: Path) -> FlightPrior:
    """Read prior.yaml. Raises UserError on a missing file, an unknown key or a wrong value."""
    return _validated(FlightPrior, _read_yaml(path, "prior"), path, "prior")


_Model = TypeVar("_Model", bound=BaseModel)


def _validated(model: type[_Model], content: dict[str, Any], path: Path, section: str) -> _Model:
    try:
        return model.model_validate_json(json.dumps(content))
    except ValidationError as error:
        raise user_error_of(error, model, section, [(str(path), content)]) from None


def _read_yaml(path: Path, section: str) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(path, section, "a folder" if path.is_dir() else "no such file", "a YAML file")
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        raise UserError(path, section, f"{path.stat().st_size} bytes", f"at most {_LARGEST_FILE_BYTES}")
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), path)
    except UnicodeDecodeError:
        raise UserError(path, section, "bytes that are not UTF-8", "a YAML file") from None
    if not isinstance(content, dict):
        raise UserError(path, section, type(content).__name__, "a mapping")
    return content
