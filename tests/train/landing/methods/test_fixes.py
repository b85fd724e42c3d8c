"""Fixes of frames of a simulated world: figures count failures as such."""

import dataclasses

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, pose, sighted, world

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import Sightings
from perilune_train.landing.methods.fixes import fix_summary, fixes_lost_in_space, fixes_near_a_prior
from perilune_train.landing.methods.seen import SeenDescent

WORLD = world()
NADIR = np.eye(3)
NOTHING = Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def descent(n=6, low_m=850.0, high_m=1500.0, mounting=NADIR):
    """Frames anywhere over the world, level to 0.3 degrees but for the mounting, with any heading."""
    rng = np.random.default_rng(3)
    true = [pose(rng, altitude) for altitude in np.linspace(high_m, low_m, n)]
    true = [Pose(one.position_m, mounting @ one.rotation_camera_from_site) for one in true]
    seen = [sighted(WORLD, one, rng) for one in true]
    ids, level = ("scene-0000", "trajectory-0000"), mounting @ ROTATION_CAMERA_FROM_BODY
    return SeenDescent(ids, CAMERA, np.arange(n) * 1.0, true, np.zeros(3), level, seen)


@pytest.mark.parametrize("method", [fixes_near_a_prior, fixes_lost_in_space])
def test_frames_are_found(method):
    figures = fix_summary(method([descent()], {"scene-0000": WORLD}, 0))
    assert figures["n_frames"] == 6
    assert figures["right_share"] == 1
    assert figures["wrong_share"] == 0
    assert figures["position_rmse_ground_px"] < 2


def test_lost_in_space_with_a_tilted_camera():
    mounting = matrix_from_rotation_vector(np.radians([12.0, -8.0, 0.0])) @ matrix_from_rotation_vector(
        np.array([0.0, 0.0, np.pi / 2])
    )
    figures = fix_summary(fixes_lost_in_space([descent(mounting=mounting)], {"scene-0000": WORLD}, 0))
    assert figures["right_share"] == 1


def test_lost_in_space_is_for_high_frames():
    low = descent(low_m=300, high_m=1500)
    above = sum(one.position_m[2] >= 800 for one in low.true)
    assert 0 < above < 6
    assert len(fixes_lost_in_space([low], {"scene-0000": WORLD}, 0)) == above


def test_frames_without_craters_and_over_other_ground_are_not_right():
    blind = descent()
    blind = dataclasses.replace(blind, sightings=[NOTHING] * 3 + blind.sightings[3:])
    figures = fix_summary(fixes_near_a_prior([blind], {"scene-0000": WORLD}, 0))
    assert figures["right_share"] == 0.5
    elsewhere = fixes_lost_in_space([descent()], {"scene-0000": world(seed=9)}, 0)
    figures = fix_summary(elsewhere)
    assert figures["right_share"] == 0
    assert figures["wrong_share"] == 0
    assert np.isnan(figures["position_rmse_m"])
