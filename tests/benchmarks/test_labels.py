"""The benchmark of the labels: it must find true labels true and wrong ones wrong by as much as they are."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.scene import rings
from perilune_render.imaging.resampling import refined
from perilune_render.labels.frame_labels import RimCircles
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import matrix_from_rotation_vector

CAMERA = Camera(160, 128, 170.0, 170.0, 70.0, 68.0)
SCALE = 8
ROTATION = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector([0.5, 0.2, 0.3])
POSITION = -400.0 * ROTATION[2]


@pytest.fixture(scope="module")
def circles():
    """Six circles about the place that the camera looks at, each tilted its own way."""
    rng = np.random.default_rng(2)
    x, y = np.array([-120, 10, 110.0, -90, 20, 120]), np.array([-60, -75, -30.0, 60, 45, 50])
    normal = rng.normal([0, 0, 1], 0.1, (6, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return RimCircles(np.arange(6), np.stack([x, y, rng.normal(0, 3, 6)], axis=1), normal, np.geomspace(6, 44, 6))


@pytest.fixture(scope="module")
def labels(circles):
    found = rings.labels_of(circles, CAMERA, POSITION, ROTATION)
    assert found.crater_id.tolist() == [0, 1, 2, 3, 4, 5]
    return found.ellipses


@pytest.fixture(scope="module")
def picture(circles, tmp_path_factory):
    folder, fine = tmp_path_factory.mktemp("rings"), refined(CAMERA, SCALE)
    return rings.render_rings(folder, circles, circles.crater_id, fine, POSITION, ROTATION, 4)


def errors(picture, ellipses):
    return rings.errors_px(rings.ring_offsets(picture, SCALE, ellipses), SCALE)


def test_true_labels_are_found_true(picture, labels):
    assert errors(picture, labels).max() < 0.02


@pytest.mark.parametrize("towards", [0.0, 0.9, 2.2])
def test_a_shifted_label_is_off_by_its_shift(picture, labels, towards):
    shifted = replace(labels, cx_px=labels.cx_px + 0.1 * np.cos(towards), cy_px=labels.cy_px + 0.1 * np.sin(towards))
    _, normals = rings.outline(labels, rings.N_DIRECTIONS)
    expected = 0.1 * np.sqrt(np.mean((normals @ [np.cos(towards), np.sin(towards)]) ** 2, axis=1))
    assert np.allclose(np.sqrt(errors(picture, shifted) ** 2 - errors(picture, labels) ** 2), expected, atol=0.01)


def test_a_label_of_another_size_is_off_by_the_difference(picture, labels):
    larger = replace(labels, a_px=labels.a_px + 0.1, b_px=labels.b_px + 0.1)
    assert np.allclose(rings.ring_offsets(picture, SCALE, larger).mean(axis=1), -0.1, atol=0.01)


def test_the_image_of_the_circles_centre_is_not_the_ellipses_centre(circles, picture, labels):
    centre = CAMERA.project(camera_from_site(circles.centre_m, POSITION, ROTATION))
    wrong = errors(picture, replace(labels, cx_px=centre[:, 0], cy_px=centre[:, 1]))
    assert wrong[-1] > 0.3 and (wrong[-3:] > 3 * errors(picture, labels)[-3:]).all()


def test_labels_that_leave_out_the_rims_tilt_are_off(circles, picture, labels):
    level = replace(circles, normal=np.tile([0.0, 0.0, 1.0], (6, 1)))
    wrong = errors(picture, rings.labels_of(level, CAMERA, POSITION, ROTATION).ellipses)
    assert (wrong > 2 * errors(picture, labels)).all() and wrong.max() > 0.3


def test_a_missing_ring_counts_as_the_farthest(picture, labels):
    assert np.allclose(errors(np.zeros_like(picture), labels), rings.REACH_PX / SCALE)
    far = replace(labels, cx_px=labels.cx_px + 2 * rings.REACH_PX / SCALE)
    assert (errors(picture, far) > 0.5).all()


def test_rings_of_one_picture_keep_apart():
    """Of the circles that crowd a place some are left out; none whose ring is in another one's reach stays."""
    rng = np.random.default_rng(3)
    crowd = RimCircles(
        np.arange(400),
        np.pad(rng.uniform(-150, 150, (400, 2)), ((0, 0), (0, 1))),
        np.tile([0.0, 0.0, 1.0], (400, 1)),
        rng.uniform(6, 40, 400),
    )
    ellipses = rings.labels_of(crowd, CAMERA, POSITION, ROTATION).ellipses
    kept = rings.rows_of(ellipses, rings.apart(ellipses, CAMERA, SCALE))
    assert 10 < len(kept.cx_px) < 100
    points, _ = rings.outline(kept, 256)
    assert (points > 0).all() and (points < [CAMERA.width_px, CAMERA.height_px]).all()
    for k in range(len(points)):
        others = np.delete(points, k, axis=0).reshape(-1, 1, 2)
        assert np.linalg.norm(others - points[k], axis=-1).min() > (rings.REACH_PX + rings.TUBE_PX + 1) / SCALE
