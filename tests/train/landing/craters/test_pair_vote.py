"""Search by votes of pairs of sightings."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, pose, sighted, world

from perilune_train.landing.craters.catalogue import CatalogueErrors, with_errors
from perilune_train.landing.craters.fix import PosePrior
from perilune_train.landing.craters.locate import _moved_px, locate
from perilune_train.landing.craters.pair_vote import _neighbours, pair_candidates
from perilune_train.landing.craters.projection import projected
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.craters.vote import SearchRange

WORLD = world()
CATALOGUE = with_errors(WORLD, CatalogueErrors(), np.random.default_rng(9))
SMALL = CATALOGUE.part(CATALOGUE.radius_m < 12)
"""Without the craters that are the largest of a frame, as over an elevation model."""
LIMITS = SearchRange(0.0, 200.0, 20.0, (-0.3, 0.3), np.radians(8))


def off_px(found, true):
    """Distance of the points in the middle of the image, pixels."""
    ray = np.array([0.0, 0.0, 1.0])
    place = [each.position_m + (ray @ each.rotation_camera_from_site) * each.position_m[2] for each in (found, true)]
    return np.linalg.norm((place[0] - place[1])[:2]) * CAMERA.fx_px / true.position_m[2]


@pytest.mark.parametrize("tilt_deg", [0.3, 8.0])
@pytest.mark.parametrize("altitude_m", [500.0, 800.0, 1400.0])
@pytest.mark.parametrize("catalogue", [CATALOGUE, SMALL], ids=["all", "small"])
def test_a_sure_pose_has_the_true_place_altitude_and_heading(catalogue, altitude_m, tilt_deg):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, altitude_m, tilt_deg=tilt_deg)
        seen = sighted(WORLD, true, rng, most=500)
        share = rng.uniform(-0.2, 0.2)
        step = np.array([*rng.uniform(-150, 150, 2), share * altitude_m, 0, 0, np.radians(rng.uniform(-7, 7))])
        limits = dataclasses.replace(LIMITS, ground_m=catalogue.ground_m(true.position_m, 30))
        found, is_sure = pair_candidates(seen, catalogue, CAMERA, true.changed(step), limits, 4_000_000)
        assert found[0].significance > 20
        assert len(found) == 1 or not is_sure
        assert off_px(found[0].pose, true) < 4
        assert abs(np.log(found[0].pose.position_m[2] / true.position_m[2])) < 0.04
        turn = found[0].pose.rotation_camera_from_site @ true.rotation_camera_from_site.T
        assert abs(np.arctan2(turn[1, 0], turn[0, 0])) < 0.05


def test_sightings_smaller_than_the_catalogue_do_not_hide_the_others():
    """Near the ground most sightings are smaller than all craters of the catalogue, and lie between the others."""
    dense = world(3, 400.0, 3.0, 0.1)
    catalogue = dense.part(dense.radius_m > 3.0)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, 200.0, reach_m=50.0)
        seen = sighted(dense, true, rng, most=500)
        large = seen.part(seen.radius_px > 0.7 * 3.0 * CAMERA.fx_px / 200)
        assert len(large) < 0.6 * len(seen)
        limits = SearchRange(catalogue.ground_m(true.position_m, 30), 5.0, 20.0, (-0.06, 0.06), 0.05)
        (found, *_), _ = pair_candidates(seen, catalogue, CAMERA, true, limits, 4_000_000)
        (expected, *_), _ = pair_candidates(large, catalogue, CAMERA, true, limits, 4_000_000)
        assert off_px(found.pose, true) < 4
        assert found.significance > 0.8 * expected.significance


def test_no_pose_is_sure_at_another_place_and_time_is_limited():
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, 900.0)
        seen = sighted(world(seed=11), true, rng, most=500)
        found, is_sure = pair_candidates(seen, CATALOGUE, CAMERA, true, LIMITS, 200_000)
        assert not is_sure
        assert all(each.significance < 20 for each in found)


def test_a_prior_that_is_off_by_many_deviations_is_searched_widely():
    rng = np.random.default_rng(5)
    true = pose(rng, 1000.0, heading_rad=0.0)
    seen = sighted(WORLD, true, rng, most=300)
    sigma = np.repeat([30.0, np.radians(0.3)], 3)
    prior = PosePrior(true.changed(np.array([200.0, -150.0, 60.0, 0.0, 0.0, 0.0])), np.diag(sigma**2))
    located = locate(seen, CATALOGUE, CAMERA, prior)
    assert located is not None and located.searched
    assert off_px(located.fix.pose, true) < 3


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_sightings_have_no_sure_pose(count):
    rng = np.random.default_rng(2)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng, most=count, false_share=0.0)
    assert len(seen) == count
    _, is_sure = pair_candidates(seen, CATALOGUE, CAMERA, true, LIMITS, 1_000_000)
    assert not is_sure
    empty = CATALOGUE.part(np.zeros(0, int))
    assert pair_candidates(seen, empty, CAMERA, true, LIMITS, 1_000_000) == ([], False)


def test_a_camera_that_sees_the_sky_is_not_searched():
    rng = np.random.default_rng(2)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng)
    assert pair_candidates(seen, CATALOGUE, CAMERA, pose(rng, 900.0, tilt_deg=60), LIMITS, 1_000_000) == ([], False)


def test_partners_are_the_nearest_between_two_distances():
    rng = np.random.default_rng(8)
    place = rng.uniform(0, 100, (60, 2))
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    expected = set()
    for i in range(60):
        allowed = [j for j in np.argsort(apart[i]) if 10 <= apart[i, j] < 25][:3]
        expected |= {(min(i, j), max(i, j)) for j in allowed}
    found = _neighbours(place, 10.0, 25.0, 3)
    assert len(found) == len(expected)
    assert {(int(i), int(j)) for i, j in found} == expected
    assert expected < set(combinations(range(60), 2))


def test_motion_of_the_image_is_the_motion_of_projected_craters():
    rng = np.random.default_rng(4)
    true = pose(rng, 900.0, tilt_deg=5.0)
    flat = WORLD.part(WORLD.radius_m < 8)
    flat = dataclasses.replace(flat, centre_m=flat.centre_m * [1, 1, 0])
    for step in (np.array([3.0, -2, 5, 0.002, 0.001, 0.004]), np.array([0, 0, 20.0, 0, 0, 0])):
        moved = true.changed(step)
        before = projected(flat, CAMERA, true, 0.0, 0.0)
        after = projected(flat.part(before.index), CAMERA, moved, np.inf, 0.0)
        largest_px = np.abs(after.centre_px - before.centre_px).max()
        assert 0.9 * largest_px < _moved_px(CAMERA, true, moved, 0.0) < 1.2 * largest_px
    assert _moved_px(CAMERA, true, true, 0.0) < 1e-9


def test_sightings_at_one_place_form_no_pairs():
    one = Sightings(np.full((20, 2), 100.0), np.full(20, 4.0), np.full(20, 0.9))
    true = pose(np.random.default_rng(1), 900.0)
    assert pair_candidates(one, CATALOGUE, CAMERA, true, LIMITS, 1_000_000) == ([], False)
