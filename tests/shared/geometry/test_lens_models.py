"""Lens models against OpenCV and against the published formulas, written again here."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.lens_models import PARAMETERS

SIZE = 256
FISHEYE = Camera(SIZE, 200, SIZE / np.pi, SIZE / np.pi, 131.0, 97.5, model="equidistant")
COEFFICIENTS = (-0.02, 0.006, -0.003, 0.0004)
KANNALA_BRANDT = replace(FISHEYE, model="kannala_brandt", parameters=COEFFICIENTS)
UNIFIED = replace(FISHEYE, model="unified", parameters=(1.3,), fx_px=180.0, fy_px=182.0)
BENT = replace(UNIFIED, parameters=(0.8,), distortion=(-0.06, 0.01, 0.002, -0.001, 0.0))
AXIS = np.array([0.02, -0.03, 1.0]) / np.linalg.norm([0.02, -0.03, 1.0])
R = (0.0002, 0.06, -0.02)
E = (0.004, 0.003, -0.001)
CAHVOR = Camera(SIZE, 200, 240.0, 241.0, 131.0, 97.5, model="cahvor", parameters=(0.3, *AXIS, *R))
CAHVORES = [
    replace(CAHVOR, model="cahvore", fx_px=110.0, fy_px=111.0, parameters=(0.3, *AXIS, *R, *E, linearity))
    for linearity in (1.0, 0.4, 0.0, -0.5)
]
CAMERAS = {
    "equidistant": FISHEYE,
    "kannala_brandt": KANNALA_BRANDT,
    "unified": UNIFIED,
    "unified with distortion": BENT,
    "cahvor": CAHVOR,
    **{f"cahvore {camera.parameters[-1]:g}": camera for camera in CAHVORES},
}


def points(widest_deg: float, n: int = 400) -> np.ndarray:
    """Points (n, 3), O_C, metres, at all distances and at angles up to `widest_deg` from z."""
    rng = np.random.default_rng(1)
    theta, turn = np.radians(rng.uniform(0, widest_deg, n)), rng.uniform(0, 2 * np.pi, n)
    rays = np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], axis=1)
    return rays * rng.uniform(1, 900, (n, 1))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_rays_invert_the_projection_in_every_pixel(camera):
    pixels = np.concatenate([camera.pixel_centres().reshape(-1, 2), camera.outline()])
    rays = camera.rays(pixels)
    seen = np.isfinite(rays).all(axis=1)
    assert seen.mean() > 0.7 and np.abs(np.linalg.norm(rays[seen], axis=1) - 1).max() < 1e-12
    for depth_m in (0.5, 7.0, 4000.0):
        found = camera.project(camera.points(pixels[seen], np.full(seen.sum(), depth_m)))
        assert np.abs(found - pixels[seen]).max() < 1e-9


@pytest.mark.parametrize("camera", [FISHEYE, KANNALA_BRANDT])
def test_fisheyes_equal_opencv(camera):
    coefficients = np.array(camera.parameters or (0.0,) * 4)
    matrix, some = camera.matrix, points(88)
    theirs = cv2.fisheye.projectPoints(some[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    assert np.abs(camera.project(some) - theirs).max() < 1e-9
    near = points(70)
    flat = cv2.fisheye.undistortPoints(camera.project(near)[:, None], matrix, coefficients)[:, 0]
    rays = camera.rays(camera.project(near))
    assert np.abs(rays[:, :2] / rays[:, 2:] - flat).max() < 1e-6


@pytest.mark.parametrize("camera", [UNIFIED, BENT])
def test_the_unified_model_equals_meis_formula(camera):
    """Project to the unit sphere, from its point (0, 0, -xi) to the plane, distort, scale (Mei and Rives 2007)."""
    some = points(89)
    on_sphere = some / np.linalg.norm(some, axis=1, keepdims=True)
    x, y = (on_sphere[:, :2] / (on_sphere[:, 2:] + camera.parameters[0])).T
    k1, k2, p1, p2, _ = camera.distortion
    square = x**2 + y**2
    scale = 1 + k1 * square + k2 * square**2
    u = x * scale + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    v = y * scale + p1 * (square + 2 * y**2) + 2 * p2 * x * y
    expected = np.stack([camera.fx_px * u + camera.cx_px, camera.fy_px * v + camera.cy_px], axis=1)
    assert np.abs(camera.project(some) - expected).max() < 1e-9


def vectors_of(camera: Camera) -> tuple[np.ndarray, ...]:
    """A, H, V, O of a camera, in O_C, for pixels counted from the outer corner."""
    skew_px, *axis = camera.parameters[:4]
    h = np.array([camera.fx_px, skew_px, camera.cx_px])
    return np.array([0.0, 0.0, 1.0]), h, np.array([0.0, camera.fy_px, camera.cy_px]), np.array(axis)


def test_cahvor_equals_its_published_formula():
    """Yakimovsky and Cunningham 1978 with the radial terms of Gennery: a point is moved away from the axis O."""
    a, h, v, o = vectors_of(CAHVOR)
    some = points(50)
    along = some @ o
    across = some - along[:, None] * o
    tau = (across**2).sum(axis=1) / along**2
    moved = some + (R[0] + R[1] * tau + R[2] * tau**2)[:, None] * across
    expected = np.stack([moved @ h, moved @ v], axis=1) / (moved @ a)[:, None]
    assert np.abs(CAHVOR.project(some) - expected).max() < 1e-9


@pytest.mark.parametrize("camera", CAHVORES, ids=lambda camera: f"{camera.parameters[-1]:g}")
def test_cahvore_equals_its_published_formula(camera):
    """Gennery 2006, with theta found by bisection: the ray from the moving pupil passes through the point."""
    a, h, v, o = vectors_of(camera)
    p = camera.parameters[-1]
    some = np.concatenate([points(50, 60) / 100, points(50, 60)])
    for point, pixel in zip(some, camera.project(some), strict=True):
        along = point @ o
        across = point - along * o
        length = np.linalg.norm(across)
        low, high = 1e-9, 1.6
        for _ in range(200):
            theta = (low + high) / 2
            pupil = (theta / np.sin(theta) - 1) * (E[0] + E[1] * theta**2 + E[2] * theta**4)
            low, high = (theta, high) if np.arctan2(length, along - pupil) > theta else (low, theta)
        chi = np.tan(p * theta) / p if p > 0 else np.sin(p * theta) / p if p < 0 else theta
        d = o + chi * (1 + R[0] + R[1] * chi**2 + R[2] * chi**4) * across / length
        assert np.abs(pixel - np.array([d @ h, d @ v]) / (d @ a)).max() < 1e-9


def test_only_the_rays_of_cahvore_start_at_different_places():
    pixels = FISHEYE.pixel_centres()
    assert not CAHVOR.ray_starts(pixels).any() and not FISHEYE.ray_starts(pixels).any()
    starts = CAHVORES[2].ray_starts(pixels)
    assert 1e-4 < np.nanmax(np.linalg.norm(starts, axis=-1)) < 0.01
    # All pupils are on the axis.
    assert np.nanmax(np.linalg.norm(np.cross(starts, AXIS), axis=-1)) < 1e-15


def test_an_image_of_180_degrees_ends_at_90_degrees():
    wide = replace(FISHEYE, cx_px=128.0, cy_px=100.0)
    edge = wide.rays([[0.0, 100.0], [256.0, 100.0], [128.0, 0.0], [0.0, 0.0]])
    assert np.allclose(edge[:2], [[-1, 0, 0], [1, 0, 0]], atol=1e-12)
    assert edge[2, 2] > 0.3 and np.isnan(edge[3]).all()
    assert np.isfinite(wide.project([[1.0, 0, 0], [1, 0, 1e-9]])).all()
    assert np.isnan(wide.project([[1.0, 0, -0.01], [0, 0, -1], [0, 0, 0]])).all()
    border = wide.border_rays([[0.0, 0.0], [256.0, 200.0]])
    assert np.allclose(border[:, 2], 0) and (np.sign(border[:, :2]) == [[-1, -1], [1, 1]]).all()
    assert not wide.folds_back()


def test_the_fold_is_where_the_radius_stops_growing():
    # r = theta + k1 theta^3 grows up to theta = 1 / sqrt(-3 k1).
    camera = replace(FISHEYE, model="kannala_brandt", parameters=(-0.25, 0.0, 0.0, 0.0))
    fold = 1 / np.sqrt(0.75)
    assert camera.fold_angle_deg == pytest.approx(np.degrees(fold), abs=1e-9)
    assert camera.folds_back()
    rays = [[np.sin(t), 0.0, np.cos(t)] for t in (fold - 1e-3, fold + 1e-3)]
    assert np.isfinite(camera.project(rays[0])).all() and np.isnan(camera.project(rays[1])).all()
    # The fold of a narrow view is outside the image, and a fold beyond 90 degrees does no harm.
    assert not replace(camera, fx_px=300.0, fy_px=300.0).folds_back()
    harmless = replace(camera, parameters=(-0.13, 0.0, 0.0, 0.0))
    assert harmless.fold_angle_deg == np.inf and not harmless.folds_back()
    assert replace(CAHVOR, parameters=(0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)).fold_angle_deg == pytest.approx(30)
    assert replace(CAHVOR, parameters=(0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0)).fold_angle_deg == 0


def test_the_unified_model_folds_where_its_distortion_does():
    # r (1 + k1 r^2) grows up to r = 1 / sqrt(-3 k1), and r = sin / (cos + xi).
    camera = replace(BENT, distortion=(-1.0, 0.0, 0.0, 0.0, 0.0))
    theta = np.radians(camera.fold_angle_deg)
    assert np.sin(theta) / (np.cos(theta) + 0.8) == pytest.approx(1 / np.sqrt(3)) and camera.folds_back()


def test_a_tangential_fold_is_found():
    # With p2 alone, dx'/dx = 1 + 6 p2 x and dy'/dy = 1 + 2 p2 x: the first is 0 at x = -1 / (6 p2).
    camera = replace(BENT, distortion=(0.0, 0.0, 0.0, 0.3, 0.0))
    theta = np.radians(camera.fold_angle_deg)
    assert np.sin(theta) / (np.cos(theta) + 0.8) == pytest.approx(1 / 1.8, abs=0.01) and camera.folds_back()
    assert np.isnan(camera.rays(camera.outline())).any()
    assert not replace(camera, fx_px=900.0, fy_px=900.0).folds_back()


def test_the_scale_is_the_largest_number_of_pixels_per_radian():
    assert FISHEYE.scale_px == pytest.approx(FISHEYE.fx_px * np.pi / 2, rel=0.01)  # across the edge at 90 degrees
    assert CAHVOR.scale_px > 240 and Camera(9, 9, 5.0, 7.0, 4.0, 4.0).scale_px == 5.0


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_point_is_projected_from_the_record_alone(camera):
    text = CameraRecord.of(camera).model_dump_json()
    again = CameraRecord.model_validate_json(text)
    assert again.intrinsics() == camera
    assert np.array_equal(again.intrinsics().project(points(40)), camera.project(points(40)))


def test_the_record_of_a_pinhole_keeps_its_form():
    record = json.loads(CameraRecord.of(Camera(64, 48, 70.0, 70.0, 32.0, 24.0)).model_dump_json())
    assert list(record) == [
        "width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "rotation_camera_from_body",
        "position_in_body_m",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"model": "fish"}, "model pinhole, equidistant"),
        ({"model": "unified"}, "parameters xi"),
        ({"parameters": {"k1": 0.1}}, "of the model equidistant"),
        ({"model": "pinhole", "parameters": {"xi": 1.0}}, "of the model pinhole"),
        ({"model": "unified", "parameters": {"xi": 1e12}}, "less than or equal"),
        ({"model": "unified", "parameters": {"xi": -0.5}}, "xi of at least 0"),
        ({"model": "cahvor", "parameters": dict.fromkeys(PARAMETERS["cahvor"], 0.0)}, "axis O that is not 0"),
        ({"model": "cahvore", "parameters": dict.fromkeys(PARAMETERS["cahvore"], 2.0)}, "linearity from -1 to 1"),
    ],
)
def test_a_wrong_record_is_refused(changes, named):
    record = json.loads(CameraRecord.of(FISHEYE).model_dump_json()) | changes
    with pytest.raises(ValueError, match=named):
        CameraRecord.model_validate_json(json.dumps(record))
