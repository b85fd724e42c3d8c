"""Settings of cameras: intrinsics, and the mounting of several cameras on one body."""

from typing import Annotated, Literal

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
MAX_PINHOLE_FOV_DEG = 120
"""Largest horizontal field of view without a lens model, degrees."""
_Vector = tuple[_Coefficient, _Coefficient, _Coefficient]
_OF_MODEL = {
    "equidistant": (),
    "kannala_brandt": ("k1", "k2", "k3", "k4"),
    "unified": ("xi",),
    "cahvor": ("skew_px", "o", "r"),
    "cahvore": ("skew_px", "o", "r", "e", "linearity"),
}
"""Settings of each lens model."""


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


class LensConfig(Section):
    """Lens model of a fisheye or planetary camera; images show up to 90 degrees from the axis (180 degrees across)."""

    model: Literal["equidistant", "kannala_brandt", "unified", "cahvor", "cahvore"]
    """Lens model. equidistant: a fisheye with r = f theta. kannala_brandt: OpenCV's fisheye. unified: the
    omnidirectional model of Mei, OpenCV's omnidir. cahvor, cahvore: planetary cameras."""
    k1: _Coefficient = 0.0
    """kannala_brandt: coefficient of theta^3."""
    k2: _Coefficient = 0.0
    """kannala_brandt: coefficient of theta^5."""
    k3: _Coefficient = 0.0
    """kannala_brandt: coefficient of theta^7."""
    k4: _Coefficient = 0.0
    """kannala_brandt: coefficient of theta^9."""
    xi: Annotated[float, Field(ge=0, le=1000)] | None = None
    """unified: distance of the projection centre from the centre of the unit sphere; required. The focal length is
    Mei's, so that the scale at the image centre is focal_length_px / (1 + xi)."""
    skew_px: _Point = 0.0
    """cahvor, cahvore: component of H along the image's y axis, pixels."""
    o: _Vector = (0.0, 0.0, 1.0)
    """cahvor, cahvore: axis O of the lens, in O_C."""
    r: _Vector = (0.0, 0.0, 0.0)
    """cahvor, cahvore: radial coefficients R."""
    e: _Vector = (0.0, 0.0, 0.0)
    """cahvore: coefficients E of the entrance pupil's motion along O, metres."""
    linearity: Annotated[float, Field(ge=-1, le=1)] = 1.0
    """cahvore: parameter P, 1 for type 1 (perspective), 0 for type 2 (fisheye), any value for type 3."""

    @model_validator(mode="after")
    def _of_this_model(self) -> "LensConfig":
        known = _OF_MODEL[self.model]
        for name in sorted(self.model_fields_set - {"model", *known}):
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{', '.join(known) or 'no parameters'} for model {self.model}, not {name}")
        if self.model == "unified" and self.xi is None:
            raise ValueError("xi for model unified")
        if not sum(each**2 for each in self.o) > 0:
            raise ValueError("an axis o that is not zero")
        return self


class CameraConfig(Section):
    """The lander's camera, looking along -Z of the body."""

    width_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image width, pixels."""
    height_px: Annotated[int, Field(ge=16, le=4096)] = 256
    """Image height, pixels."""
    horizontal_fov_deg: Annotated[float, Field(ge=1, le=180)] = 50.0
    """Horizontal field of view over the image width, without distortion, degrees; at most 120 without `lens`."""
    focal_length_px: Pixels | None = None
    """Focal length, pixels; null computes it from horizontal_fov_deg. A lens model scales x' by it."""
    focal_length_y_px: Pixels | None = None
    """Focal length in pixel heights, for pixels that are not square; null takes focal_length_px."""
    principal_x_px: _Point | None = None
    """Principal point, from the left edge, pixels; null takes the image centre."""
    principal_y_px: _Point | None = None
    """Principal point, from the top edge, pixels; null takes the image centre."""
    distortion: DistortionConfig = DistortionConfig()
    """Lens distortion; without `lens`, or with its model unified."""
    lens: LensConfig | None = None
    """Lens model of a fisheye or planetary camera; null is a pinhole with `distortion`. The engine must be
    heightfield on the processor."""

    @model_validator(mode="after")
    def _with_lens(self) -> "CameraConfig":
        if self.lens is None and self.horizontal_fov_deg > MAX_PINHOLE_FOV_DEG:
            raise ValueError(f"horizontal_fov_deg of at most {MAX_PINHOLE_FOV_DEG} without dataset.camera.lens")
        if self.lens is not None and self.lens.model != "unified" and self.distortion != DistortionConfig():
            raise ValueError(f"no distortion with lens model {self.lens.model}, or the model unified")
        return self


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
