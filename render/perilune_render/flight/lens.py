"""The camera of a configuration."""

import numpy as np

from perilune_render.config.cameras import CameraConfig
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera

_LARGEST_COVER = 9
"""Largest number of rendered pixels, as a multiple of the camera's pixels."""


def camera_of(config: CameraConfig, section: str = "dataset.camera") -> Camera:
    """The camera of a configuration's section. Raises UserError if its distortion is too strong.

    The distortion is too strong if the distorted image folds back on itself, or if the pinhole camera that covers the
    view has more than _LARGEST_COVER times the camera's pixels.
    """
    width, height, lens = config.width_px, config.height_px, config.distortion
    focal = config.focal_length_px or width / 2 / np.tan(np.radians(config.horizontal_fov_deg) / 2)
    camera = Camera(
        width,
        height,
        float(focal),
        float(config.focal_length_y_px or focal),
        width / 2 if config.principal_x_px is None else config.principal_x_px,
        height / 2 if config.principal_y_px is None else config.principal_y_px,
        (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3),
    )
    if camera.folds_back():
        raise UserError(
            "configuration",
            f"{section}.distortion",
            camera.distortion,
            "no distortion that folds back within the image; use a weaker one, or a narrower view",
        )
    covering = camera.covering_pinhole()
    if covering.width_px * covering.height_px > _LARGEST_COVER * width * height:
        raise UserError(
            "configuration",
            f"{section}.distortion",
            camera.distortion,
            f"a weaker distortion (this one needs a rendering of {covering.width_px} x {covering.height_px} pixels)",
        )
    return camera
