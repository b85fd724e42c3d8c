import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perilune_shared.camera import Camera, camera_from_site

CAMERA = Camera(width_px=256, height_px=200, fx_px=300.0, fy_px=310.0, cx_px=128.0, cy_px=90.0)


def test_the_axis_hits_the_principal_point():
    assert np.allclose(CAMERA.project([0, 0, 7.0]), [128, 90])


def test_x_is_right_and_y_is_down():
    assert np.allclose(CAMERA.project([1.0, 2.0, 10.0]), [128 + 30, 90 + 62])


def test_the_calibration_matrix_projects_alike():
    point = np.array([0.4, -0.7, 3.0])
    homogeneous = CAMERA.matrix @ point
    assert np.allclose(CAMERA.project(point), homogeneous[:2] / homogeneous[2])


def test_the_first_pixels_centre_lies_at_a_half():
    centres = CAMERA.pixel_centres()
    assert centres.shape == (200, 256, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5] and centres[3, 5].tolist() == [5.5, 3.5]


def test_behind_the_camera_there_is_no_pixel():
    assert np.isnan(CAMERA.project([0, 0, -1.0])).all()
    assert not CAMERA.inside(CAMERA.project([0, 0, -1.0]))


def test_field_of_view_spans_the_width():
    camera = Camera.from_field_of_view(256, 256, 50.0)
    assert np.allclose(camera.project([np.tan(np.radians(25)), 0, 1]), [256, 128])


@given(st.floats(0, 256), st.floats(0, 200), st.floats(0.1, 1e4))
def test_rays_undo_projection(u, v, depth):
    assert np.allclose(CAMERA.project(CAMERA.rays([u, v]) * depth), [u, v], atol=1e-9)


def test_points_are_seen_from_the_camera():
    # Looking down from 10 m: the ground point below and 2 m along X lies right of the axis, at depth 10.
    down = np.diag([1.0, -1.0, -1.0])
    assert np.allclose(camera_from_site([2.0, 1.0, 0.0], [0, 0, 10.0], down), [2, -1, 10])
