"""Poses from altitude and tilt, from a place to look at, and along a descent."""

import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.geometry.poses import descent, listed, look_at, look_down

TILTED = [look_down(800), look_down(500, 10), look_down(500, 60, 130)]
POSES = [*TILTED, look_at((300, 0, 500)), look_at((0, 0, 5), (1, 2, 9))]


@pytest.mark.parametrize("pose", POSES)
def test_the_attitude_is_a_rotation(pose):
    rotation = pose.rotation_camera_from_site
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(matrix_from_quaternion(pose.rotation_wxyz), rotation, atol=1e-12)


@pytest.mark.parametrize(("azimuth_deg", "north_px"), [(0, (0, -1)), (90, (-1, 0)), (180, (0, 1)), (270, (1, 0))])
def test_the_top_of_the_image_points_to_the_azimuth(azimuth_deg, north_px):
    """x of the image is to the right and y down; north is -Y of O_L."""
    north = look_down(800, 0, azimuth_deg).rotation_camera_from_site @ (0, -1, 0)
    np.testing.assert_allclose(north[:2], north_px, atol=1e-12)


def test_a_map_is_not_mirrored():
    east = look_down(800).rotation_camera_from_site @ (-1, 0, 0)
    np.testing.assert_allclose(east, (1, 0, 0), atol=1e-12)


@pytest.mark.parametrize("azimuth_deg", [0, 90, 200])
def test_the_line_of_sight_leans_to_the_azimuth(azimuth_deg):
    pose = look_down(1000, 30, azimuth_deg)
    sight = pose.rotation_camera_from_site[2]
    ground = pose.position_m + sight * 1000 / -sight[2]
    assert np.hypot(*ground[:2]) == pytest.approx(1000 * np.tan(np.radians(30)))
    assert np.degrees(np.arctan2(-ground[0], -ground[1])) % 360 == pytest.approx(azimuth_deg)
    assert pose.tilt_deg == pytest.approx(30)


@pytest.mark.parametrize("place", [(300, 0, 500), (-200, 400, 90), (0, 0, 500), (10, 10, -5)])
def test_the_target_is_in_the_middle(place):
    target = np.array([5.0, -3.0, 2.0])
    pose = look_at(place, target)
    seen = pose.rotation_camera_from_site @ (target - pose.position_m)
    np.testing.assert_allclose(seen, (0, 0, np.linalg.norm(target - place)), atol=1e-9)
    # Upright: up in space is up in the image.
    assert (pose.rotation_camera_from_site @ (0, 0, 1))[1] <= 1e-12


def test_a_descent_is_the_nominal_one_of_datasets():
    poses = descent(5, start_altitude_m=1000, end_altitude_m=100, downrange_m=300, azimuth_deg=90, duration_s=30)
    np.testing.assert_allclose(poses[0].position_m, (-300, 0, 1000), atol=1e-9)
    np.testing.assert_allclose(poses[-1].position_m, (0, 0, 100), atol=1e-9)
    assert [pose.velocity_mps[2] for pose in poses] == pytest.approx([-30] * 5)
    assert poses[-1].velocity_mps[:2] == pytest.approx((0, 0))
    for pose in poses:
        np.testing.assert_allclose(pose.rotation_camera_from_site, np.diag([1, -1, -1]), atol=1e-12)


def test_a_pose_says_where_it_is():
    assert repr(look_down(800, 10)) == "Pose(x 0.0 m west, y 0.0 m south, z 800.0 m up, tilt 10.0 degrees)"
    assert repr(descent(2)[1]).endswith("tilt 0.0 degrees, 20 m/s)")


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: look_down(0), "altitude_m"),
        (lambda: look_down("800"), "altitude_m"),
        (lambda: look_down(float("nan")), "altitude_m"),
        (lambda: look_down(800, 181), "tilt_deg"),
        (lambda: look_at((1, 2)), "position_m"),
        (lambda: look_at("here"), "position_m"),
        (lambda: look_at((1, 2, 3), (1, 2, 3)), "target_m"),
        (lambda: descent(1), "n_frames"),
        (lambda: descent(2.5), "n_frames"),
        (lambda: descent(5, duration_s=0), "duration_s"),
        (lambda: listed([look_down(5), "b"]), "pose"),
    ],
)
def test_values_out_of_range_are_refused(make, field):
    with pytest.raises(UserError) as raised:
        make()
    assert raised.value.field == field
