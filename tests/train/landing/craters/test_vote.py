"""Search by votes, and the support of a pose."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, nearby, pose, sighted, world

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY as MOUNTING
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.landing.craters.catalogue import CatalogueErrors, with_errors
from perilune_train.landing.craters.fix import PosePrior, refine
from perilune_train.landing.craters.locate import is_clear, locate, lost_in_space
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.search import Area
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.craters.vote import (
    LOST,
    LOST_FINELY,
    Candidate,
    SearchRange,
    candidates,
    refined,
    support,
)

WORLD = world()
CATALOGUE = with_errors(WORLD, CatalogueErrors(), np.random.default_rng(9))
SMALL = CATALOGUE.part(CATALOGUE.radius_m < 12)
"""Without the craters that are the largest of a frame, as over an elevation model."""


@pytest.mark.parametrize("altitude_m", [600.0, 1000.0, 1400.0])
@pytest.mark.parametrize("catalogue", [CATALOGUE, SMALL], ids=["all", "small"])
def test_a_pose_is_found_with_and_without_the_largest_craters(catalogue, altitude_m):
    sigma = np.array([100.0] * 3 + [np.radians(1.0)] * 3)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, altitude_m, heading_rad=0.0)
        seen = sighted(WORLD, true, rng, most=500)
        prior = PosePrior(true.changed(sigma * rng.normal(size=6)), np.diag(sigma**2))
        located = locate(seen, catalogue, CAMERA, prior)
        assert located is not None and located.searched
        assert np.linalg.norm(located.fix.pose.position_m - true.position_m) * CAMERA.fx_px / altitude_m < 5


@pytest.mark.parametrize("effort", [LOST, LOST_FINELY], ids=["coarsely", "finely"])
def test_candidates_contain_shift_altitude_and_heading(effort):
    rng = np.random.default_rng(2)
    true = pose(rng, 900.0, tilt_deg=0.0, heading_rad=0.3)
    seen = sighted(WORLD, true, rng, most=300)
    expected = true.changed(np.concatenate([[30.0, -50.0, 80.0], np.radians([0.0, 0.0, 5.0])]))
    limits = SearchRange(0.0, 0.0, 60.0, (-0.2, 0.2), np.radians(8))
    found = candidates(seen, CATALOGUE, CAMERA, expected, limits, effort)
    assert 8 <= len(found) <= effort.n_candidates
    assert np.linalg.norm(found[0].pose.position_m - true.position_m) < 50
    assert [each.significance for each in found] == sorted((each.significance for each in found), reverse=True)


def test_a_second_vote_finds_the_true_pose_among_candidates():
    rng = np.random.default_rng(6)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng, most=500)
    off = true.changed(np.array([12.0, -9.0, 20.0, 0.0, 0.0, 0.03]))
    wrong = [true.changed(np.array([x, y, 0.0, 0.0, 0.0, 0.0])) for x in (-150, 150) for y in (-150, 150)]
    again = refined(seen, SMALL, CAMERA, [Candidate(each, 50.0) for each in wrong] + [Candidate(off, 1.0)])
    assert np.linalg.norm(again[0].pose.position_m - true.position_m) < 25
    assert again[0].significance > 3 * again[1].significance


def test_groups_of_craters_and_repeated_sightings_are_not_significant():
    """Each pair of a group of sightings and a group of craters votes for one shift, which says little."""
    rng = np.random.default_rng(7)
    expected = pose(rng, 900.0, tilt_deg=0.0, heading_rad=0.0)
    groups_px = np.repeat(rng.uniform(20, 236, (12, 2)), 8, axis=0) + rng.normal(size=(96, 2))
    seen = Sightings(groups_px, np.full(96, 4.0), np.full(96, 0.9))
    centres_m = np.repeat(rng.uniform(-600, 600, (60, 2)), 8, axis=0) + 3 * rng.normal(size=(480, 2))
    part = WORLD.part(np.arange(480))
    grouped = replace(
        part, centre_m=np.column_stack([centres_m, np.zeros(480)]), radius_m=np.full(480, 4.0 * 900 / CAMERA.fx_px)
    )
    limits = SearchRange(0.0, 200.0, 20.0, (-0.1, 0.1), np.radians(8))
    found = candidates(seen, grouped, CAMERA, expected, limits, LOST)
    assert found[0].significance < 20


def test_a_camera_that_is_lost_in_space_without_the_largest_craters():
    rng = np.random.default_rng(1)
    true = pose(rng, 1000.0, reach_m=200.0)
    seen = sighted(WORLD, true, rng, most=300)
    turn = matrix_from_rotation_vector(np.array([0.0, 0.0, rng.uniform(-3, 3)]))
    prior = PosePrior(Pose(np.array([0.0, 0.0, 1050.0]), turn @ MOUNTING), np.eye(6))
    area = Area(np.zeros(2), 300.0, (950.0, 1150.0), np.pi)
    located = lost_in_space(seen, SMALL, CAMERA, prior, area)
    assert located is not None
    assert np.linalg.norm(located.fix.pose.position_m - true.position_m) * CAMERA.fx_px / 1000 < 5


def test_candidates_of_another_place_are_not_clear():
    rng = np.random.default_rng(2)
    true = pose(rng, 1000.0)
    seen = sighted(world(seed=11), true, rng, most=300)
    limits = SearchRange(0.0, 300.0, 20.0, (-0.1, 0.1), np.radians(60))
    voted = refined(seen, SMALL, CAMERA, candidates(seen, SMALL, CAMERA, true, limits, LOST))
    assert voted and not is_clear(voted)


def test_support_is_large_at_the_true_pose_and_chance_elsewhere():
    rng = np.random.default_rng(3)
    true = pose(rng, 900.0)
    seen = sighted(WORLD, true, rng, most=300)
    assert support(seen, CATALOGUE, CAMERA, true).sigmas > 30
    shifted = [
        support(seen, CATALOGUE, CAMERA, true.changed(np.r_[x, y, 0, 0, 0, 0])) for x in (-90, 70) for y in (60, -80)
    ]
    assert all(agreed.sigmas < 5 for agreed in shifted)
    assert support(Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0)), CATALOGUE, CAMERA, true).n_agreed == 0


def test_dense_craters_do_not_pull_a_fix_away():
    """From the true pose, and from an error of 5 px; with twice as many craters as sightings."""
    dense = world(seed=3, least_m=6.0, per_m2=0.15)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, 1200.0)
        seen = sighted(dense, true, rng, found_share=0.5, false_share=0.6, most=300)
        for shift_m in (0.0, 18.0):
            prior = nearby(true, [shift_m, -shift_m, 0.0], [0, 0, 0.2])
            fix = refine(seen, dense, CAMERA, prior, prior.pose)
            assert np.linalg.norm(fix.pose.position_m - true.position_m) * CAMERA.fx_px / 1200 < 3


@pytest.mark.parametrize("height_m", [-500.0, 0.0, 30.0, 1e6])
def test_an_absurd_prior_takes_bounded_memory(height_m):
    rng = np.random.default_rng(4)
    true = pose(rng, 300.0)
    seen = sighted(WORLD, true, rng)
    off = true.changed(np.r_[0, 0, height_m - 300.0, 0, 0, 0])
    locate(seen, CATALOGUE, CAMERA, PosePrior(off, np.diag(np.square([1000.0] * 3 + [1.0] * 3))))
