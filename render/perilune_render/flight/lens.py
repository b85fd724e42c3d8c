"""The camera of a configuration."""

import numpy as np

from perilune_render.config.cameras import CameraConfig, LensConfig
from perilune_render.config.dataset import RenderConfig
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.lens_models import lens_of

_LARGEST_COVER = 9
"""Largest number of rendered pixels, as a multiple of the camera's pixels."""


def camera_of(config: CameraConfig, section: str = "dataset.camera") -> Camera:
    """The camera of a configuration's section. Raises UserError if its distortion is too strong.

    The distortion is too strong if the distorted image folds back on itself, or if the pinhole camera that covers the
    view has more than _LARGEST_COVER times the camera's pixels. A lens model may not fold back within the image.
    """
    width, height, distortion = config.width_px, config.height_px, config.distortion
    parameters = () if config.lens is None else _parameters(config.lens)
    model = "pinhole" if config.lens is None else config.lens.model
    focal = config.focal_length_px
    if focal is None and config.lens is not None:
        focal = _focal_px(config, section, parameters)
    focal = focal or width / 2 / np.tan(np.radians(config.horizontal_fov_deg) / 2)
    camera = Camera(
        width,
        height,
        float(focal),
        float(config.focal_length_y_px or focal),
        width / 2 if config.principal_x_px is None else config.principal_x_px,
        height / 2 if config.principal_y_px is None else config.principal_y_px,
        (distortion.k1, distortion.k2, distortion.p1, distortion.p2, distortion.k3),
        model,
        parameters,
    )
    faulty = f"{section}.distortion" if config.lens is None or any(camera.distortion) else f"{section}.lens"
    if camera.folds_back():
        raise UserError(
            "configuration",
            faulty,
            camera.distortion if faulty.endswith("distortion") else f"{model} {_named(config.lens)}",
            f"no distortion that folds back within the image{_where(camera)}; use a weaker one, or a narrower view",
        )
    if camera.lens is not None:
        if not np.isfinite(camera.scale_px):
            found = "an image without a ray within 90 degrees of the axis"
            raise UserError("configuration", f"{section}.lens", found, "a principal point nearer to the image")
        return camera
    covering = camera.covering_pinhole()
    if covering.width_px * covering.height_px > _LARGEST_COVER * width * height:
        raise UserError(
            "configuration",
            f"{section}.distortion",
            camera.distortion,
            f"a weaker distortion (this one needs a rendering of {covering.width_px} x {covering.height_px} pixels)",
        )
    return camera


def check_engine(camera: Camera, render: RenderConfig, section: str) -> None:
    """Raise UserError if the engine of a configuration does not render the camera's lens model."""
    if camera.lens is not None and (render.engine, render.device) != ("heightfield", "cpu"):
        found = f"{camera.model} with dataset.render.engine={render.engine}, device={render.device}"
        expected = "dataset.render.engine=heightfield and device=cpu, or no lens: other engines render pinholes"
        raise UserError("configuration", f"{section}.lens", found, expected)


def _parameters(lens: LensConfig) -> tuple[float, ...]:
    """Parameters of a lens in the order of `lens_models.PARAMETERS`."""
    if lens.model == "kannala_brandt":
        return lens.k1, lens.k2, lens.k3, lens.k4
    if lens.model == "unified":
        return (lens.xi or 0.0,)
    if lens.model == "equidistant":
        return ()
    x, y, z = (float(each) for each in np.array(lens.o) / np.linalg.norm(lens.o))
    shared = lens.skew_px, x, y, z, *lens.r
    return shared if lens.model == "cahvor" else (*shared, *lens.e, lens.linearity)


def _focal_px(config: CameraConfig, section: str, parameters: tuple[float, ...]) -> float:
    """Focal length of a lens model for its horizontal field of view, without distortion, pixels.

    Raises UserError if the model has no image at the edge of the field of view.
    """
    assert config.lens is not None
    lens, half = lens_of(config.lens.model, parameters), np.radians(config.horizontal_fov_deg) / 2
    fold_deg = float(np.degrees(lens.fold_rad))
    if half >= lens.fold_rad:
        expected = f"a view within {fold_deg:.2f} degrees from the axis, where the lens model folds back"
        found = f"{config.lens.model} {_named(config.lens)} with horizontal_fov_deg {config.horizontal_fov_deg:g}"
        raise UserError("configuration", f"{section}.lens", found, expected)
    radius = float(lens.radius(np.array(min(half, np.pi / 2))))
    if not 0 < radius < 1e6:
        expected = f"below 180 for lens model {config.lens.model}"
        raise UserError("configuration", f"{section}.horizontal_fov_deg", config.horizontal_fov_deg, expected)
    return config.width_px / 2 / radius


def _named(lens: LensConfig | None) -> str:
    """The parameters of a lens that differ from the defaults, for messages."""
    stated = {} if lens is None else lens.model_dump(exclude={"model"}, exclude_defaults=True)
    return ", ".join(f"{name} {value}" for name, value in stated.items())


def _where(camera: Camera) -> str:
    """The angle of a fold, for messages; empty if the fold is not radial."""
    angle = camera.fold_angle_deg
    return f" (the model folds at {angle:.2f} degrees from the axis)" if np.isfinite(angle) else ""
