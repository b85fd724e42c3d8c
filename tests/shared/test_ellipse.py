import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from perilune_shared.camera import Camera
from perilune_shared.ellipse import project_circles, rim_points

CAMERA = Camera(256, 256, 280.0, 260.0, 120.0, 131.0)


def one(centre, normal, radius):
    normal = np.array([normal], float)
    return project_circles(
        CAMERA, np.array([centre], float), normal / np.linalg.norm(normal), np.array([radius], float)
    )


def test_a_circle_seen_straight_on():
    camera = Camera(256, 256, 250.0, 250.0, 128.0, 128.0)
    ellipse = project_circles(camera, np.array([[1.0, -2.0, 10.0]]), np.array([[0, 0, -1.0]]), np.array([0.4]))
    assert np.allclose([ellipse.cx_px, ellipse.cy_px], [[128 + 25], [128 - 50]])
    assert np.allclose([ellipse.a_px, ellipse.b_px], [[10], [10]])
    assert np.allclose(ellipse.bounding_boxes(), [[143, 68, 163, 88]])
    assert np.allclose(ellipse.radius_px(), 10)


@settings(max_examples=200)
@given(
    st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(200, 1500)),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, -0.3)),
    st.floats(1.0, 80.0),
)
def test_projected_rim_points_lie_on_the_ellipse(centre, normal, radius):
    # Seen edge on, a circle has no ellipse.
    assume(abs(np.dot(centre, normal)) > 0.02 * np.linalg.norm(centre) * np.linalg.norm(normal))
    ellipse = one(centre, normal, radius)
    unit = np.array([normal]) / np.linalg.norm(normal)
    pixels = CAMERA.project(rim_points(np.array([centre]), unit, np.array([radius]), 720))[0]
    dx, dy = pixels[:, 0] - ellipse.cx_px, pixels[:, 1] - ellipse.cy_px
    cos, sin = np.cos(ellipse.theta_rad), np.sin(ellipse.theta_rad)
    on = ((dx * cos + dy * sin) / ellipse.a_px) ** 2 + ((dy * cos - dx * sin) / ellipse.b_px) ** 2
    assert np.allclose(on, 1, atol=1e-7)
    assert ellipse.a_px >= ellipse.b_px > 0 and 0 <= ellipse.theta_rad <= np.pi
    box = ellipse.bounding_boxes()[0]
    seen = [*pixels.min(axis=0), *pixels.max(axis=0)]
    assert np.allclose(box, seen, atol=2e-4 * radius * 280 / 200 + 1e-6)


def test_the_image_of_the_centre_is_not_the_ellipses_centre():
    ellipse = one((0, 0, 10), (0, 1, -1), 4)
    assert abs(ellipse.cy_px[0] - CAMERA.project([0, 0, 10.0])[1]) > 5


@pytest.mark.parametrize(
    ("centre", "normal"), [((0, 0, 1), (0, 1, -0.01)), ((0, 0, -5), (0, 0, 1)), ((0, 0, 10), (1, 0, 0))]
)
def test_a_circle_with_no_elliptical_image_gives_nan(centre, normal):
    ellipse = one(centre, normal, 3)
    assert np.isnan(ellipse.a_px).all() and np.isnan(ellipse.bounding_boxes()).all()


def test_no_circle_gives_no_ellipse():
    empty = project_circles(CAMERA, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert empty.bounding_boxes().shape == (0, 4)
