from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import Ellipses, fit_ellipses, project_circles, rim_points

CAMERA = Camera(256, 256, 280.0, 260.0, 120.0, 131.0)


def one(centre, normal, radius):
    normal = np.array([normal], float)
    return project_circles(
        CAMERA, np.array([centre], float), normal / np.linalg.norm(normal), np.array([radius], float)
    )


def test_a_circle_facing_the_camera():
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
    # A circle seen edge on has no ellipse.
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


def test_the_projected_centre_differs_from_the_ellipse_centre():
    ellipse = one((0, 0, 10), (0, 1, -1), 4)
    assert abs(ellipse.cy_px[0] - CAMERA.project([0, 0, 10.0])[1]) > 5


@pytest.mark.parametrize(
    ("centre", "normal"), [((0, 0, 1), (0, 1, -0.01)), ((0, 0, -5), (0, 0, 1)), ((0, 0, 10), (1, 0, 0))]
)
def test_a_circle_with_no_elliptical_image_gives_nan(centre, normal):
    ellipse = one(centre, normal, 3)
    assert np.isnan(ellipse.a_px).all() and np.isnan(ellipse.bounding_boxes()).all()


def test_empty_input_gives_no_ellipses():
    empty = project_circles(CAMERA, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert empty.bounding_boxes().shape == (0, 4)


def craters_in_view(n=400):
    rng = np.random.default_rng(7)
    centres = np.append(rng.uniform(-0.4, 0.4, (n, 2)), np.ones((n, 1)), axis=1) * rng.uniform(200, 1500, (n, 1))
    normals = rng.normal([0, 0, -1], 0.15, (n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return centres, normals, np.geomspace(0.5, 45, n) / 270 * centres[:, 2]


def distance_px(ellipses: Ellipses, pixels: np.ndarray) -> np.ndarray:
    """Return the distance of points (N, M, 2) from N ellipses, pixels, to first order (N, M)."""
    dx, dy = pixels[..., 0] - ellipses.cx_px[:, None], pixels[..., 1] - ellipses.cy_px[:, None]
    cos, sin = np.cos(ellipses.theta_rad)[:, None], np.sin(ellipses.theta_rad)[:, None]
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    a, b = ellipses.a_px[:, None], ellipses.b_px[:, None]
    return np.abs((u / a) ** 2 + (v / b) ** 2 - 1) / (2 * np.hypot(u / a**2, v / b**2))


def test_a_distorted_rim_is_close_to_its_ellipse():
    camera = replace(CAMERA, distortion=(-0.1, 0.02, 0.001, -0.001, 0.0))
    circles = craters_in_view()
    ellipses = project_circles(camera, *circles)
    apart = distance_px(ellipses, camera.project(rim_points(*circles, 90)))
    assert np.isfinite(apart).all() and apart.max() < 0.05
    # The fit of small ellipses is better, since their distortion is nearly uniform.
    assert apart[ellipses.radius_px() < 10].max() < 0.005
    plain = project_circles(CAMERA, *circles)
    assert np.abs(plain.cx_px - ellipses.cx_px).max() > 2
    assert distance_px(plain, camera.project(rim_points(*circles, 90))).max() > 2


def test_the_fit_without_distortion_equals_the_conic():
    circles = craters_in_view()
    exact, fitted = project_circles(CAMERA, *circles), fit_ellipses(CAMERA.project(rim_points(*circles, 64)))
    for name in ("cx_px", "cy_px", "a_px", "b_px"):
        assert np.abs(getattr(exact, name) - getattr(fitted, name)).max() < 1e-6
    # A tiny distortion uses the fit and gives the same ellipse.
    hardly = project_circles(replace(CAMERA, distortion=(1e-12, 0.0, 0.0, 0.0, 0.0)), *circles)
    assert np.abs(hardly.bounding_boxes() - exact.bounding_boxes()).max() < 1e-6


def test_a_slender_ellipse_is_fitted():
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    x, y = 1e-3 * np.cos(angle), 2e-5 * np.sin(angle)
    points = np.stack([700 + 0.8 * x - 0.6 * y, -300 + 0.6 * x + 0.8 * y], axis=-1)[None]
    ellipse = fit_ellipses(points)
    assert np.allclose([ellipse.cx_px, ellipse.cy_px], [[700], [-300]], atol=1e-9)
    assert np.allclose([ellipse.a_px, ellipse.b_px], [[1e-3], [2e-5]], rtol=1e-4)


@pytest.mark.parametrize(
    ("centre", "normal"),
    [((0, 0, 1), (0, 1, -0.01)), ((0, 0, -5), (0, 0, 1)), ((0, 0, 10), (1, 0, 0)), ((9, 0, 8), (0, 0, -1))],
)
def test_an_invisible_circle_gives_nan_with_distortion(centre, normal):
    camera = replace(CAMERA, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    seen = np.array([[1.0, 0.5, 20.0], centre], float)
    normals = np.array([[0, 0, -1.0], normal]) / np.linalg.norm([[0, 0, -1.0], normal], axis=1, keepdims=True)
    ellipse = project_circles(camera, seen, normals, np.array([3.0, 3.0]))
    assert np.isfinite(ellipse.a_px[0]) and np.isnan(ellipse.bounding_boxes()[1]).all()
    empty = project_circles(camera, np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert empty.bounding_boxes().shape == (0, 4)
