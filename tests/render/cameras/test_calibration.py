"""A camera from another program's calibration in the renderer: pixels that are not square, recorded settings."""

import json

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.cli.frames import read_camera
from perilune_render.flight.lens import camera_of
from perilune_render.provenance.recipe import recorded_settings
from perilune_shared.errors import UserError

KALIBR = {
    "camera_model": "pinhole",
    "distortion_coeffs": [-0.05, 0.01, 1e-3, -5e-4],
    "distortion_model": "radtan",
    "intrinsics": [290.0, 291.5, 159.0, 120.5],
    "resolution": [320, 240],
}


def write(tmp_path, content):
    path = tmp_path / "camera.yaml"
    path.write_text(json.dumps(content))
    return path


def test_the_camera_of_a_calibration_is_that_of_the_renderer(tmp_path):
    camera = camera_of(read_camera(write(tmp_path, {"cam0": KALIBR})))
    assert (camera.width_px, camera.height_px) == (320, 240)
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (290.0, 291.5, 159.5, 121.0)
    assert camera.distortion == (-0.05, 0.01, 1e-3, -5e-4, 0.0)


def test_square_pixels_are_recorded_as_before(tmp_path):
    """Datasets of older versions have no key for the other focal length."""
    config = config_with()
    assert "focal_length_y_px" not in recorded_settings(config, "nav")["camera"]
    own = config.model_copy(update={"camera": read_camera(write(tmp_path, KALIBR))})
    assert recorded_settings(own, "nav")["camera"]["focal_length_y_px"] == 291.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": [8192, 8192]}, "camera.width_px: got 8192, expected at most 4096"),
        ({"intrinsics": [1e-3, 1e-3, 0, 0]}, "fold"),
        ({"camera_model": "ds"}, "camera_model: got ds, expected pinhole or omni"),
    ],
)
def test_what_the_renderer_cannot_do_is_refused(tmp_path, change, message):
    with pytest.raises(UserError, match=message):
        camera_of(read_camera(write(tmp_path, KALIBR | change)))


def test_rays_of_pixels_that_are_not_square():
    config = config_with().camera.model_copy(update={"focal_length_px": 100.0, "focal_length_y_px": 50.0})
    camera = camera_of(config)
    far = camera.rays([[camera.cx_px + 100, camera.cy_px + 100]])[0]
    assert np.allclose(far, [1, 2, 1])
