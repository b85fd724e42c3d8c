"""Alignment of two drawn views of a textured ground with a hill."""

import numpy as np
import pytest

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.classical.alignment import Prior, State, align
from perilune_train.motion.classical.contrast import local_contrast, pyramid, sampled
from perilune_train.motion.classical.estimate import ExpectedMotion, GroundPlane
from perilune_train.motion.classical.ground import carried, ground_points, node_pixels, node_weights, unknown_heights
from perilune_train.motion.classical.klt import NOMINAL_TURN_SIGMA_RAD

CAMERA = Camera.from_field_of_view(160, 160, 45.0)
DOWN = np.array([0.0, 0.0, 1.0])
ALTITUDE_M = 1000.0
RNG = np.random.default_rng(3)
WAVES = RNG.normal(size=(60, 2)) * 0.06, RNG.uniform(0, 2 * np.pi, 60)


def _height_m(x, y):
    return 15 * np.exp(-((x - 120) ** 2 + (y + 80) ** 2) / (2 * 150**2))


def _picture(position, rotation_from_first, rng=None):
    """An 8-bit picture from a position, in O_C of the first camera, of the ground at depth ALTITUDE_M below it."""
    rays = CAMERA.rays(CAMERA.pixel_centres()) @ rotation_from_first
    depth = np.full(rays.shape[:2], ALTITUDE_M - position[2])
    for _ in range(30):
        points = position + rays * depth[..., None]
        depth = (ALTITUDE_M - _height_m(points[..., 0], points[..., 1]) - position[2]) / rays[..., 2]
    points = position + rays * depth[..., None]
    light = sum(np.cos(points[..., :2] @ wave + phase) for wave, phase in zip(*WAVES, strict=True))
    grey = 100 + 8 * light + (rng.normal(size=light.shape) if rng is not None else 0)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


MOTION = np.array([12.0, -9.0, 30.0])
TURN = matrix_from_rotation_vector([0.003, -0.002, 0.004])


def _prior(turn_sigma_rad=NOMINAL_TURN_SIGMA_RAD):
    heights = unknown_heights(CAMERA, DOWN, ALTITUDE_M)
    motion = ExpectedMotion(MOTION + np.array([1.5, -1, 2]), np.eye(3), turn_sigma_rad)
    return Prior(motion, GroundPlane(DOWN, ALTITUDE_M), heights)


def _aligned(seed, prior):
    rng = np.random.default_rng(seed)
    first = pyramid(_picture(np.zeros(3), np.eye(3), rng), CAMERA, 2)
    second = pyramid(_picture(MOTION, TURN, rng), CAMERA, 2)
    start = State(prior.motion.translation_m, prior.motion.rotation_c2_from_c1, np.zeros(2), prior.heights.mean_m)
    return align(first, second, prior, start)


def test_motion_and_heights_are_found():
    prior = _prior()
    found, covariance = _aligned(1, prior)
    assert np.linalg.norm(found.translation_m - MOTION) < 0.5  # of a motion of 34 m, from a start 2.7 m beside it
    assert np.degrees(np.linalg.norm(rotation_vectors(found.rotation_c2_from_c1 @ TURN.T))) < 0.03
    nodes = ground_points(CAMERA, node_pixels(CAMERA), DOWN, ALTITUDE_M)
    true = _height_m(nodes[:, 0], nodes[:, 1])
    assert np.corrcoef(found.height_m, true)[0, 1] > 0.8
    assert np.sqrt(np.mean((found.height_m - true) ** 2)) < 0.5 * np.sqrt(np.mean(true**2))
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert np.diag(covariance)[8:].mean() < 0.7 * np.diag(prior.heights.covariance_m2).mean()


def test_a_known_rotation_makes_the_shift_better():
    prior = _prior()
    known = Prior(ExpectedMotion(prior.motion.translation_m, TURN, 1e-5), prior.plane, prior.heights)
    (free, loose), (held, tight) = _aligned(1, prior), _aligned(1, known)
    assert np.linalg.norm(held.translation_m - MOTION) < 0.1
    assert np.linalg.norm(held.translation_m - MOTION) < np.linalg.norm(free.translation_m - MOTION)
    assert (np.diag(tight)[3:5] < 0.3 * np.diag(loose)[3:5]).all()


def test_a_featureless_ground_gives_the_prior():
    blank = pyramid(np.full((160, 160), 90, np.uint8), CAMERA, 2)
    prior = _prior()
    start = State(prior.motion.translation_m, np.eye(3), np.zeros(2), prior.heights.mean_m)
    found, covariance = align(blank, blank, prior, start)
    np.testing.assert_allclose(found.translation_m, prior.motion.translation_m)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)[:3]), NOMINAL_TURN_SIGMA_RAD)


def test_local_contrast_ignores_brightness_that_varies_slowly():
    image = _picture(np.zeros(3), np.eye(3)).astype(float)
    ramp = np.linspace(0.5, 1.0, 160)
    plain, shaded = (local_contrast(np.clip(grey, 0, 255).astype(np.uint8)) for grey in (image, image * ramp))
    inner = np.s_[10:-10, 10:-10]
    assert np.corrcoef(plain[inner].ravel(), shaded[inner].ravel())[0, 1] > 0.99


def test_values_between_pixels():
    maps = np.arange(12, dtype=np.float32).reshape(1, 3, 4)
    found = sampled(maps, np.array([[0.5, 0.5], [1.0, 1.0], [3.4, 2.4], [3.6, 1.0], [0.4, 1.0], [np.nan, 1.0]]))
    np.testing.assert_allclose(found[0, :3], [0, 2.5, 10.5], rtol=1e-5)
    assert np.isnan(found[0, 3:]).all()


def test_weights_of_nodes_add_up_to_one_and_interpolate():
    pixels = np.array([[0, 0], [160, 160], [80, 80], [33.0, 71.0]])
    weights = node_weights(CAMERA, pixels)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights @ node_pixels(CAMERA), pixels, rtol=1e-5, atol=1e-4)


def test_heights_carried_without_motion_stay_and_tend_to_the_plane():
    heights = unknown_heights(CAMERA, DOWN, ALTITUDE_M)
    known = type(heights)(np.linspace(-5, 5, 25), 0.1 * heights.covariance_m2)
    still = np.zeros(3), np.eye(3)
    kept = carried(known, CAMERA, (DOWN, DOWN), (ALTITUDE_M, ALTITUDE_M), still)
    assert np.allclose(kept.mean_m, known.mean_m * (kept.mean_m[0] / known.mean_m[0]))
    assert 0.9 < kept.mean_m[0] / known.mean_m[0] < 1
    share = np.diag(kept.covariance_m2) / np.diag(heights.covariance_m2)
    assert (share > 0.1).all() and (share < 0.2).all()
    # Over ground that frame 1 did not see, nothing is known.
    far = carried(known, CAMERA, (DOWN, DOWN), (ALTITUDE_M, ALTITUDE_M), (np.array([9000.0, 0, 0]), np.eye(3)))
    assert np.abs(far.mean_m).max() < 0.1
    assert np.diag(far.covariance_m2) == pytest.approx(np.diag(heights.covariance_m2), rel=0.01)
