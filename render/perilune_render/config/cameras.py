"""Settings of cameras: intrinsics, and the mounting of several cameras on one body."""

from typing import Annotated

from pydantic import Field, model_validator

from perilune_render.config.values import Pixels
from perilune_shared.config.resolve import Section
from perilune_shared.dataset.names import CAMERA_PATTERN

CameraName = Annotated[str, Field(pattern=CAMERA_PATTERN)]
_Angle = Annotated[float, Field(ge=-180, le=180)]
_Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]
_Point = Annotated[float, Field(ge=-100_000, le=100_000)]
_Cosine = Annotated[float, Field(ge=-1.01, le=1.01)]
_Offset = Annotated[float, Field(ge=-20, le=20)]
_UNIT_TOLERANCE = 1e-3


class DistortionConfig(Section):
    """Brown-Conrady lens distortion in OpenCV's form, on image coordinates divided by the focal length."""

    k1: _Coefficient = 0.0
    """Radial coefficient of r^2."""
    k2: _Coefficient = 0.0
    """Radial coefficient of r^4."""
    p1: _Coefficient = 0.0
    """First tangential coefficient."""
    p2: _Coefficient = 0.0
    """Second tangential coefficient."""
    k3: _Coefficient = 0.0
    """Radial coefficient of r^6."""


class CameraConfig(Section):
    """The lander's camera, looking along -Z of the body."""

    width_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image width, pixels."""
    height_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image height, pixels."""
    horizontal_fov_deg: Annotated[float, Field(ge=1, le=120)] = 50.0
    """Horizontal field of view over the image width, without distortion, degrees."""
    focal_length_px: Pixels | None = None
    """Focal length, pixels; null computes it from horizontal_fov_deg."""
    focal_length_y_px: Pixels | None = None
    """Focal length in pixel heights, for pixels that are not square; null takes focal_length_px."""
    principal_x_px: _Point | None = None
    """Principal point, from the left edge, pixels; null takes the image centre."""
    principal_y_px: _Point | None = None
    """Principal point, from the top edge, pixels; null takes the image centre."""
    distortion: DistortionConfig = DistortionConfig()
    """Lens distortion."""


class MountingConfig(Section):
    """Position and attitude of a camera on the body; the defaults are the values for `dataset.camera`."""

    position_in_body_m: tuple[_Offset, _Offset, _Offset] = (0.0, 0.0, 0.0)
    """Centre of projection in O_B (the axes of the body), metres."""
    turned_deg: tuple[_Angle, _Angle, _Angle] = (0.0, 0.0, 0.0)
    """Rotations of the camera about X_B, then Y_B, then Z_B, from its default attitude, degrees. The default looks
    along -Z_B with image x along X_B; [15, 0, 0] turns the view towards Y_B."""
    rotation_camera_from_body_wxyz: tuple[_Cosine, _Cosine, _Cosine, _Cosine] | None = None
    """Unit quaternion that replaces turned_deg; (0, 1, 0, 0) is the default attitude."""

    @model_validator(mode="after")
    def _one_rotation(self) -> "MountingConfig":
        rotation = self.rotation_camera_from_body_wxyz
        if rotation is not None and any(self.turned_deg):
            raise ValueError("turned_deg or rotation_camera_from_body_wxyz, not both")
        if rotation is not None and abs(sum(each**2 for each in rotation) - 1) > _UNIT_TOLERANCE:
            raise ValueError("rotation_camera_from_body_wxyz of length 1")
        return self


class MountedCameraConfig(CameraConfig):
    """One of several cameras on the body."""

    mounting: MountingConfig = MountingConfig()
    """Position and attitude on the body."""
