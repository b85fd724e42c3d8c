"""Poses from craters on simulated ground, with errors of a stated size."""

import dataclasses

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, nearby, pose, sighted, world

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.landing.craters.catalogue import CatalogueErrors, with_errors
from perilune_train.landing.craters.fix import PosePrior, refine
from perilune_train.landing.craters.locate import locate
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import Sightings

WORLD = world()


def off(fix, true):
    """The step (6,) from a fix to the true pose."""
    turn = rotation_vectors(true.rotation_camera_from_site @ fix.pose.rotation_camera_from_site.T)
    return np.concatenate([true.position_m - fix.pose.position_m, turn])


def test_a_camera_with_a_lens_model_is_refused():
    """A fisheye taken for a pinhole would give wrong poses."""
    fisheye = dataclasses.replace(CAMERA, model="equidistant")
    with pytest.raises(UserError, match=r"camera\.model: got equidistant, expected pinhole"):
        projected(WORLD, fisheye, pose(np.random.default_rng(3), 900.0))


def test_projection_has_the_derivatives_by_the_pose():
    true = pose(np.random.default_rng(3), 900.0, tilt_deg=8.0)
    # Small craters: the offset between an ellipse's centre and the circle's is left out of the derivative.
    small = WORLD.part(WORLD.radius_m < 12)
    seen = projected(small, CAMERA, true)
    inside = (np.abs(seen.centre_px - 128) < 120).all(axis=1)
    for k, step in enumerate([1e-2] * 3 + [1e-5] * 3):
        column = np.zeros(6)
        column[k] = step
        moved = projected(small.part(seen.index), CAMERA, true.changed(column), margin_px=50, least_radius_px=0)
        found = (moved.centre_px - seen.centre_px) / step
        np.testing.assert_allclose(seen.jacobian()[inside, :2, k], found[inside], rtol=5e-3, atol=5e-3 / step * 1e-2)


def test_centres_of_large_tilted_circles_leave_no_bias():
    rng = np.random.default_rng(4)
    true = pose(rng, 700.0, tilt_deg=12.0)
    large = WORLD.part(WORLD.radius_m > 20)
    seen = sighted(large, true, rng, 1.0, 0.0, noisy=False)
    images = projected(large, CAMERA, true)
    points = (large.centre_m[images.index] - true.position_m) @ true.rotation_camera_from_site.T
    naive = points[:, :2] / points[:, 2:] * CAMERA.fx_px + [CAMERA.cx_px, CAMERA.cy_px]
    order = np.argsort(-images.radius_px)
    prior = nearby(true, [4, -3, 5], [0.1, 0.1, 0.2])
    found = refine(seen, large, CAMERA, prior, prior.pose)
    wrong = refine(dataclasses.replace(seen, centre_px=naive[order]), large, CAMERA, prior, prior.pose)
    error_m, naive_m = (np.linalg.norm(off(one, true)[:3]) for one in (found, wrong))
    assert error_m < 0.15
    assert naive_m > 3 * error_m


@pytest.mark.parametrize("tilt_deg", [30.0, 45.0, 60.0])
def test_predicted_centres_are_those_of_the_ellipses_under_tilt(tilt_deg):
    tilt = matrix_from_rotation_vector(np.radians([tilt_deg, 0.0, 0.0]))
    true = Pose(np.array([0.0, 0.0, 500.0]), ROTATION_CAMERA_FROM_BODY @ tilt.T)
    seen = projected(WORLD, CAMERA, true, least_radius_px=10.0)
    points = (WORLD.centre_m[seen.index] - true.position_m) @ true.rotation_camera_from_site.T
    normals = WORLD.normal[seen.index] @ true.rotation_camera_from_site.T
    ellipses = project_circles(CAMERA, points, normals, WORLD.radius_m[seen.index])
    np.testing.assert_allclose(seen.centre_px, np.column_stack([ellipses.cx_px, ellipses.cy_px]), atol=1e-6)
    naive_px = np.linalg.norm(CAMERA.project(points) - seen.centre_px, axis=1)
    assert len(naive_px) > 3 and np.median(naive_px) > 0.15, "the image of the centre of the rim is another point"


@pytest.mark.parametrize(("false_share", "found_share"), [(0.2, 0.8), (1.0, 0.8)])
def test_errors_have_the_stated_size(false_share, found_share):
    """With a false sighting for every true one too."""
    squared, rms_px = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = pose(rng, rng.uniform(300, 1400))
        seen = sighted(WORLD, true, rng, found_share, false_share)
        prior = nearby(true, rng.normal(size=3) * 4, rng.normal(size=3) * 0.1)
        fix = refine(seen, WORLD, CAMERA, prior, prior.pose)
        error = off(fix, true)
        squared.append(error @ np.linalg.solve(fix.covariance, error))
        rms_px.append(np.linalg.norm(error[:3]) * CAMERA.fx_px / true.position_m[2])
    # 60 errors of 6 parts: the mean has a deviation of 0.45; that common to a frame's centres is stated and not drawn.
    assert 3.5 < np.mean(squared) < 8.0
    assert np.median(rms_px) < 1.0


def test_a_fix_names_places_in_the_whole_catalogue():
    rng = np.random.default_rng(6)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng, 0.9, 0.0)
    prior = nearby(true, [3, -2, 2], [0.1, 0.1, 0.1])
    fix = refine(seen, WORLD, CAMERA, prior, prior.pose)
    assert len(fix.crater) > 20 and fix.crater.max() > 20
    images = projected(WORLD.part(fix.crater), CAMERA, fix.pose, margin_px=50, least_radius_px=0)
    np.testing.assert_array_equal(images.index, np.arange(len(fix.crater)))
    distance = np.linalg.norm(images.centre_px - seen.centre_px[fix.sighting], axis=1)
    assert np.median(distance) < 1.0 and (distance < 6).all()


def test_no_fix_from_few_sightings_or_another_place():
    rng = np.random.default_rng(5)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng)
    few = Sightings(seen.centre_px[:5], seen.radius_px[:5], seen.score[:5])
    prior = nearby(true, np.zeros(3), np.zeros(3))
    assert refine(few, WORLD, CAMERA, prior, true) is None
    empty = Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert refine(empty, WORLD, CAMERA, prior, true) is None
    far = dataclasses.replace(true, position_m=true.position_m + np.array([900, 0, 0]))
    certain = dataclasses.replace(prior, pose=far, covariance=np.diag(np.square([1.0] * 3 + [1e-3] * 3)))
    found = locate(seen, WORLD, CAMERA, certain)
    assert found is None


@pytest.mark.parametrize("altitude_m", [300.0, 800.0, 1400.0])
def test_prior_of_100_m_and_1_degree(altitude_m):
    sigma = np.array([100.0] * 3 + [np.radians(1.0)] * 3)
    catalogue = with_errors(WORLD, CatalogueErrors(), np.random.default_rng(9))
    for seed in range(6):
        rng = np.random.default_rng(seed)
        true = pose(rng, altitude_m, heading_rad=0.0)
        seen = sighted(WORLD, true, rng)
        step = sigma * rng.normal(size=6) * [1, 1, min(1, altitude_m / 800), 1, 1, 1]
        prior = PosePrior(true.changed(step), np.diag(sigma**2))
        found = locate(seen, catalogue, CAMERA, prior)
        assert found is not None
        error = off(found.fix, true)
        assert error @ np.linalg.solve(found.fix.covariance, error) < 40
        # At 300 m, craters of the catalogue are few and off by a pixel each.
        assert altitude_m < 500 or np.linalg.norm(error[:3]) * CAMERA.fx_px / altitude_m < 5


def test_boxes_are_those_of_the_ellipses():
    rng = np.random.default_rng(4)
    normal = np.array([0, 0, 1]) + 0.3 * rng.normal(size=(len(WORLD), 3))
    catalogue = dataclasses.replace(WORLD, normal=normal / np.linalg.norm(normal, axis=1, keepdims=True))
    true = pose(rng, 900.0, tilt_deg=10)
    seen = projected(catalogue, CAMERA, true)
    part, rotation = catalogue.part(seen.index), true.rotation_camera_from_site
    boxes = project_circles(CAMERA, seen.point_m, part.normal @ rotation.T, part.radius_m).bounding_boxes()
    assert len(boxes) > 300
    np.testing.assert_allclose(seen.centre_px, (boxes[:, :2] + boxes[:, 2:]) / 2, atol=1e-9)
    np.testing.assert_allclose(seen.radius_px, np.sqrt(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)) / 2, atol=1e-9)
