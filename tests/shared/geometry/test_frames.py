import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perilune_shared.geometry import frames

ANGLES = st.floats(-np.pi, np.pi)


def test_quaternion_of_a_quarter_turn_about_z():
    half = np.sqrt(0.5)
    expected = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(frames.matrix_from_quaternion([half, 0, 0, half]), expected)
    assert np.allclose(frames.quaternion_from_matrix(expected), [half, 0, 0, half])


@given(ANGLES, ANGLES, ANGLES)
def test_quaternion_and_matrix_are_inverse(a, b, c):
    matrix = frames.matrix_from_rotation_vector([a, b, c])
    quaternion = frames.quaternion_from_matrix(matrix)
    assert np.isclose(np.linalg.norm(quaternion), 1) and quaternion[0] >= 0
    assert np.allclose(frames.matrix_from_quaternion(quaternion), matrix, atol=1e-12)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-12) and np.isclose(np.linalg.det(matrix), 1)


def test_rotation_vector_rotates_by_its_length():
    turned = frames.matrix_from_rotation_vector([0, 0, np.radians(30)]) @ [1, 0, 0]
    assert np.allclose(turned, [np.cos(np.radians(30)), np.sin(np.radians(30)), 0])


@pytest.mark.parametrize(
    ("azimuth", "expected"), [(0, [0, -1, 0]), (90, [-1, 0, 0]), (180, [0, 1, 0]), (270, [1, 0, 0])]
)
def test_sun_azimuth_is_clockwise_from_north(azimuth, expected):
    # Y is south and X is west, so north is -Y and east is -X.
    assert np.allclose(frames.sun_direction(azimuth, 0), expected, atol=1e-12)


def test_sun_at_the_zenith():
    assert np.allclose(frames.sun_direction(123, 90), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(("latitude", "longitude"), [(0, 30), (40, 0), (-45.5, 177.6), (60, -100), (-20, -70)])
def test_the_earth_is_above_the_centre_of_the_near_side(latitude, longitude):
    x, y = frames.site_from_selenographic(0.0, 0.0, latitude, longitude)
    angle = np.hypot(x, y) / frames.MOON_RADIUS_M
    expected = np.array([*(np.array([x, y]) / np.hypot(x, y) * np.sin(angle)), np.cos(angle)])
    assert frames.earth_direction(latitude, longitude) == pytest.approx(expected, abs=1e-9)
    assert frames.earth_direction(0, 0) == pytest.approx([0, 0, 1])


def test_a_degree_south_of_the_site():
    metres = frames.MOON_RADIUS_M * np.pi / 180
    latitude, longitude = frames.selenographic_from_site(0.0, metres, -45.0, 10.0)
    assert np.allclose([latitude, longitude], [-46, 10])


def test_x_is_west():
    _, longitude = frames.selenographic_from_site(1000.0, 0.0, 0.0, 10.0)
    assert longitude < 10


@given(st.floats(-5e4, 5e4), st.floats(-5e4, 5e4), st.floats(-89.9, 89.9), st.floats(-180, 180))
def test_site_and_selenographic_are_inverse(x, y, latitude, longitude):
    lat, lon = frames.selenographic_from_site(x, y, latitude, longitude)
    back = frames.site_from_selenographic(lat, lon, latitude, longitude)
    assert np.allclose(back, [x, y], atol=1e-4)


def test_rotations_equal_scipy_up_to_rounding():
    rng = np.random.default_rng(3)
    quaternions = rng.normal(size=(200, 4))
    expected = Rotation.from_quat(quaternions, scalar_first=True)
    matrices = frames.matrix_from_quaternion(quaternions)
    np.testing.assert_allclose(matrices, expected.as_matrix(), rtol=0, atol=4e-15)
    found = np.array([frames.quaternion_from_matrix(matrix) for matrix in matrices])
    np.testing.assert_allclose(found, expected.as_quat(canonical=True, scalar_first=True), rtol=0, atol=4e-15)
    vectors = rng.normal(size=(200, 3))
    found = np.array([frames.matrix_from_rotation_vector(vector) for vector in vectors])
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), rtol=0, atol=4e-15)
