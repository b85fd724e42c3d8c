"""What a draw changes, and that nothing else does."""

import numpy as np
import pytest
from tests.train.landing.methods.test_fixes import descent

from perilune_shared.geometry.inertial_grades import GRADES, HOUR_S
from perilune_train.landing.filter.flight import Instruments
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.methods.flights import default_sigmas
from perilune_train.landing.monte_carlo.draw import drawn
from perilune_train.landing.monte_carlo.scenario import SCENARIOS

SIGMAS = default_sigmas("tactical", 0.5)
STILL = Instruments(
    Increments(0.01 * np.arange(1, 3001), np.full(3000, 0.01), np.zeros((3000, 3)), np.tile([0, 0, 1.62], (3000, 1))),
    np.arange(300) / 10,
    np.full(300, 800.0),
)


def draw(scenario="nominal", seed=0, n=30):
    one = descent(n)
    return one, drawn(one, STILL, "tactical", SIGMAS, scenario, np.random.default_rng(seed))


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_seed_gives_a_draw_and_another_seed_another(scenario):
    (_, first), (_, again), (_, other) = draw(scenario), draw(scenario), draw(scenario, seed=1)
    np.testing.assert_array_equal(first.start_error, again.start_error)
    assert not np.isclose(first.start_error, other.start_error).any()
    one, two = first.instruments.inertial, again.instruments.inertial
    np.testing.assert_array_equal(one.angular_rate_radps, two.angular_rate_radps)
    assert [len(one) for one in first.descent.sightings] == [len(one) for one in again.descent.sightings]


def test_inertial_errors_and_starts_have_the_stated_size():
    offs, turns, pushes = [], [], []
    for seed in range(200):
        _, one = draw(seed=seed, n=2)
        offs.append(one.start_error)
        turns.append(one.instruments.inertial.angular_rate_radps.mean(axis=0))
        pushes.append(one.instruments.inertial.specific_force_mps2.mean(axis=0) - [0, 0, 1.62])
    np.testing.assert_allclose(np.std(offs, axis=0), SIGMAS[:9], rtol=0.2)
    # Means over 30 s: bias and integrated noise; the walk of the bias is below a tenth of it.
    unit, seconds = GRADES["tactical"], 30.0
    noise = np.radians(unit.angular_random_walk_deg) / np.sqrt(HOUR_S * seconds)
    np.testing.assert_allclose(np.std(turns), np.hypot(np.radians(unit.gyro_bias_deg_per_h) / HOUR_S, noise), rtol=0.1)
    noise = unit.velocity_random_walk_mps / np.sqrt(HOUR_S * seconds)
    np.testing.assert_allclose(np.std(pushes), np.hypot(unit.accelerometer_bias_mg * 9.80665e-3, noise), rtol=0.1)


def test_a_nominal_draw_leaves_detections_and_ranges():
    one, found = draw()
    assert found.descent is one
    assert found.instruments.range_m is STILL.range_m


def test_an_outage_takes_ten_seconds_of_detections():
    one, found = draw("outage")
    blind = [len(own) == 0 for own in found.descent.sightings]
    assert sum(blind) == 10
    first = blind.index(True)
    assert all(blind[first : first + 10])
    assert all(found.descent.sightings[k] is one.sightings[k] for k in range(30) if not blind[k])


def test_a_wrong_prior_is_300_m_off_over_ground():
    _, found = draw("wrong-prior")
    assert np.isclose(np.hypot(*found.start_error[:2]), 300)
    assert abs(found.start_error[2]) < 250


def test_half_of_the_detections_are_false():
    one, found = draw("false-detections")
    for before, after in zip(one.sightings, found.descent.sightings, strict=True):
        assert len(after) == 2 * len(before)
        np.testing.assert_array_equal(np.sort(after.radius_px), np.sort(np.tile(before.radius_px, 2)))
        true = (after.centre_px[:, None] == before.centre_px).all(axis=2).any(axis=1)
        assert true.sum() == len(before)
        assert (np.diff(after.radius_px) <= 0).all()
