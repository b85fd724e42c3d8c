"""Frames anywhere over a catalogue."""

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, nearby, pose, sighted, world

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_train.landing.craters.catalogue import CatalogueErrors, with_errors
from perilune_train.landing.craters.locate import lost_in_space
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.search import Area

CATALOGUE = with_errors(world(), CatalogueErrors(), np.random.default_rng(7))


def find(seen, altitude_m, catalogue=CATALOGUE):
    """The pose somewhere over 4 km, with any heading, the altitude known within 10 %."""
    level = Pose(np.array([0, 0, altitude_m]), ROTATION_CAMERA_FROM_BODY)
    area = Area(np.zeros(2), 1500.0, (0.9 * altitude_m, 1.1 * altitude_m), np.pi)
    prior = nearby(level, np.zeros(3), np.zeros(3))
    return lost_in_space(seen, catalogue, CAMERA, prior, area)


@pytest.mark.parametrize("altitude_m", [800.0, 1100.0, 1450.0])
def test_frames_are_found_without_a_prior(altitude_m):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true = pose(rng, altitude_m, reach_m=1000.0)
        found = find(sighted(world(), true, rng), altitude_m * rng.uniform(0.95, 1.05))
        assert found is not None
        assert found.searched
        assert np.linalg.norm(found.fix.pose.position_m - true.position_m) * CAMERA.fx_px / altitude_m < 5


def test_another_place_is_not_found():
    elsewhere = world(seed=1)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        true = pose(rng, 1000.0)
        assert find(sighted(elsewhere, true, rng), 1000.0) is None
