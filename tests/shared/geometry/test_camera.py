from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perilune_shared.geometry.camera import Camera, camera_from_site

CAMERA = Camera(width_px=256, height_px=200, fx_px=300.0, fy_px=310.0, cx_px=128.0, cy_px=90.0)


def test_the_optical_axis_projects_to_the_principal_point():
    assert np.allclose(CAMERA.project([0, 0, 7.0]), [128, 90])


def test_x_is_right_and_y_is_down():
    assert np.allclose(CAMERA.project([1.0, 2.0, 10.0]), [128 + 30, 90 + 62])


def test_the_calibration_matrix_gives_the_same_projection():
    point = np.array([0.4, -0.7, 3.0])
    homogeneous = CAMERA.matrix @ point
    assert np.allclose(CAMERA.project(point), homogeneous[:2] / homogeneous[2])


def test_the_first_pixel_centre_is_at_one_half():
    centres = CAMERA.pixel_centres()
    assert centres.shape == (200, 256, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5] and centres[3, 5].tolist() == [5.5, 3.5]


def test_points_behind_the_camera_give_nan():
    assert np.isnan(CAMERA.project([0, 0, -1.0])).all()
    assert not CAMERA.inside(CAMERA.project([0, 0, -1.0]))


def test_field_of_view_spans_the_width():
    camera = Camera.from_field_of_view(256, 256, 50.0)
    assert np.allclose(camera.project([np.tan(np.radians(25)), 0, 1]), [256, 128])


@given(st.floats(0, 256), st.floats(0, 200), st.floats(0.1, 1e4))
def test_rays_invert_projection(u, v, depth):
    assert np.allclose(CAMERA.project(CAMERA.rays([u, v]) * depth), [u, v], atol=1e-9)


def test_transform_from_site_to_camera():
    # Looking down from 10 m, the ground point 2 m along X is right of the axis, at depth 10 m.
    down = np.diag([1.0, -1.0, -1.0])
    assert np.allclose(camera_from_site([2.0, 1.0, 0.0], [0, 0, 10.0], down), [2, -1, 10])


LENSES = [
    (-0.2, 0.05, 0.001, -0.002, -0.01),
    (0.3, 0.0, 0.0, 0.0, 0.0),
    (-0.3, 0.0, 0.0, 0.0, 0.0),
    (0, 0, 0.01, 0.02, 0),
]


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_equals_opencv(lens):
    camera = replace(CAMERA, distortion=lens)
    rng = np.random.default_rng(1)
    points = np.append(rng.uniform(-0.4, 0.4, (500, 2)), np.ones((500, 1)), axis=1) * rng.uniform(1, 900, (500, 1))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(lens))[0][:, 0]
    pixels = camera.project(points)
    assert np.abs(pixels - theirs).max() < 1e-9
    assert np.abs(pixels - CAMERA.project(points)).max() > 1
    exact = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
    rays = cv2.undistortPointsIter(pixels[:, None], CAMERA.matrix, np.array(lens), np.eye(3), np.eye(3), exact)[:, 0]
    assert np.abs(camera.rays(pixels)[:, :2] - rays).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES)
def test_rays_invert_distortion_in_every_pixel(lens):
    camera = replace(CAMERA, distortion=lens)
    pixels = camera.pixel_centres()
    assert np.abs(camera.project(camera.rays(pixels) * 70.0) - pixels).max() < 1e-7


@pytest.mark.parametrize("lens", [(0.0, -1e300, 0.0, 0.0, -1e300), (1e300, 0.1, 0.0, 0.0, -1e300)])
def test_absurd_distortions_have_no_rays(lens):
    """dataset.json is untrusted: its distortion may overflow, but must not end the program."""
    with np.errstate(all="ignore"):
        assert np.isnan(replace(CAMERA, distortion=lens).rays(CAMERA.outline())).any()


def test_without_distortion_the_covering_pinhole_is_the_camera():
    assert CAMERA.covering_pinhole() == CAMERA


@pytest.mark.parametrize("lens", LENSES)
def test_the_covering_pinhole_is_as_small_as_possible(lens):
    camera = replace(CAMERA, distortion=lens)
    pinhole = camera.covering_pinhole()
    assert not any(pinhole.distortion) and (pinhole.fx_px, pinhole.fy_px) == (camera.fx_px, camera.fy_px)
    seen = pinhole.project(camera.rays(camera.outline()))
    assert pinhole.covers(camera) and (seen >= 0).all() and (seen <= [pinhole.width_px, pinhole.height_px]).all()
    # The image grows by whole pixels, and on each side by no more than needed.
    left, top = pinhole.cx_px - camera.cx_px, pinhole.cy_px - camera.cy_px
    right, bottom = pinhole.width_px - camera.width_px - left, pinhole.height_px - camera.height_px - top
    spare = [*seen.min(axis=0), *(np.array([pinhole.width_px, pinhole.height_px]) - seen.max(axis=0))]
    for grown, left_over in zip((left, top, right, bottom), spare, strict=True):
        assert grown == int(grown) >= 0 and (grown == 0 or left_over < 1)


def test_covers():
    assert CAMERA.covers(CAMERA) and CAMERA.covers(replace(CAMERA, width_px=200))
    assert not CAMERA.covers(replace(CAMERA, width_px=257)) and not CAMERA.covers(replace(CAMERA, fx_px=290.0))


def test_points_beyond_the_fold_give_nan():
    # r (1 - 0.3 r^2) has its maximum at r = 1 / sqrt(0.9).
    camera = replace(CAMERA, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    fold = 1 / np.sqrt(0.9)
    pixels = camera.project([[0.999 * fold, 0, 1], [1.001 * fold, 0, 1], [3.0, 0, 1]])
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1:]).all()
    farthest = camera.fx_px * fold * (1 - 0.3 * fold**2) + camera.cx_px
    assert np.isfinite(camera.rays([farthest - 0.1, camera.cy_px])).all()
    assert np.isnan(camera.rays([farthest + 0.1, camera.cy_px])[:2]).all()


def test_a_distortion_that_folds_back_in_the_image_has_no_covering_pinhole():
    camera = replace(CAMERA, distortion=(-1.5, 0.0, 0.0, 0.0, 0.0))
    assert camera.folds_back() and not CAMERA.folds_back()
    with pytest.raises(ValueError, match="folds back"):
        camera.covering_pinhole()
