"""What a draw changes, and that nothing else does."""

import dataclasses

import numpy as np
import pytest
from tests.train.landing.methods.test_fixes import WORLD, descent

from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import CALIBRATED, GRADES, HOUR_S
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.filter.flight import Instruments
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.methods.flights import default_sigmas
from perilune_train.landing.monte_carlo.draw import DOPPLER_BEAMS, Site, drawn, outage
from perilune_train.landing.monte_carlo.motion import TrueMotion, true_motion
from perilune_train.landing.monte_carlo.scenario import SCENARIOS, Draws, Sensors

SIGMAS = default_sigmas("tactical", 0.5)
N_STEPS = 3000
STILL = Instruments(
    Increments(
        0.01 * np.arange(1, N_STEPS + 1),
        np.full(N_STEPS, 0.01),
        np.zeros((N_STEPS, 3)),
        np.tile([0, 0, 1.62], (N_STEPS, 1)),
    ),
    np.arange(300) / 10,
    np.full(300, 800.0),
)
VELOCITY_MPS = np.array([3.0, -2.0, -20.0])
MOTION = TrueMotion(STILL.inertial.time_s, np.tile(VELOCITY_MPS, (N_STEPS, 1)), np.tile(np.eye(3), (N_STEPS, 1, 1)))
DESCENT = descent(31)


def site(reference=STILL):
    return Site(DESCENT, reference, WORLD, MOTION, [])


def draw(scenario="nominal", seed=0, number=0, reference=STILL, **sensors):
    return drawn(site(reference), Draws(scenario, seed=seed, sensors=Sensors(**sensors)), SIGMAS, number)


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_seed_gives_a_draw_and_another_seed_or_number_another(scenario):
    first, again = draw(scenario), draw(scenario)
    np.testing.assert_array_equal(first.start_error, again.start_error)
    np.testing.assert_array_equal(first.catalogue.centre_m, again.catalogue.centre_m)
    np.testing.assert_array_equal(first.instruments.range_m, again.instruments.range_m)
    one, two = first.instruments.inertial, again.instruments.inertial
    np.testing.assert_array_equal(one.angular_rate_radps, two.angular_rate_radps)
    assert [len(one) for one in first.descent.sightings] == [len(one) for one in again.descent.sightings]
    for other in (draw(scenario, seed=1), draw(scenario, number=1)):
        assert not np.isclose(first.start_error, other.start_error).any()
        assert (first.instruments.range_m != other.instruments.range_m).all()


def test_another_sensor_or_outage_leaves_the_other_errors():
    plain = draw()
    full = draw(star_tracker_hz=1.0, doppler_hz=2.0, altimeter_outage_s=5.0, detections_outage_s=5.0)
    np.testing.assert_array_equal(plain.start_error, full.start_error)
    np.testing.assert_array_equal(plain.catalogue.centre_m, full.catalogue.centre_m)
    np.testing.assert_array_equal(
        plain.instruments.inertial.specific_force_mps2, full.instruments.inertial.specific_force_mps2
    )
    there = np.isfinite(full.instruments.range_m)
    np.testing.assert_array_equal(plain.instruments.range_m[there], full.instruments.range_m[there])


@pytest.mark.parametrize(("unit", "errors"), [("tactical", GRADES["tactical"]), ("calibrated", CALIBRATED)])
def test_inertial_errors_and_starts_have_the_stated_size(unit, errors):
    offs, turns, pushes = [], [], []
    for number in range(200):
        one = draw(number=number, unit=unit)
        offs.append(one.start_error)
        turns.append(one.instruments.inertial.angular_rate_radps.mean(axis=0))
        pushes.append(one.instruments.inertial.specific_force_mps2.mean(axis=0) - [0, 0, 1.62])
    np.testing.assert_allclose(np.std(offs, axis=0), SIGMAS[:9], rtol=0.2)
    # Means over 30 s: bias and integrated noise; the walk of the bias is below a tenth of it.
    seconds = 30.0
    noise = np.radians(errors.angular_random_walk_deg) / np.sqrt(HOUR_S * seconds)
    np.testing.assert_allclose(
        np.std(turns), np.hypot(np.radians(errors.gyro_bias_deg_per_h) / HOUR_S, noise), rtol=0.1
    )
    noise = errors.velocity_random_walk_mps / np.sqrt(HOUR_S * seconds)
    np.testing.assert_allclose(np.std(pushes), np.hypot(errors.accelerometer_bias_mg * 9.80665e-3, noise), rtol=0.1)


@pytest.mark.parametrize(
    ("sensors", "scale_ppm", "misalignment_arcsec"),
    [
        ({"unit": "tactical"}, 0, 0),
        ({"unit": "cubesat"}, 1000, 200),
        ({"unit": "tactical", "scale_ppm": 5e4, "misalignment_arcsec": 4e4}, 5e4, 4e4),
        ({"unit": "cubesat", "scale_ppm": 0.0, "misalignment_arcsec": 0.0}, 0, 0),
    ],
)
def test_scale_factors_and_misalignments_have_the_stated_size(sensors, scale_ppm, misalignment_arcsec):
    """A large specific force along one axis separates them from biases and noise."""
    strong = dataclasses.replace(
        STILL, inertial=dataclasses.replace(STILL.inertial, specific_force_mps2=np.tile([1e4, 0, 0], (N_STEPS, 1)))
    )
    found = [
        draw(number=number, reference=strong, **sensors).instruments.inertial.specific_force_mps2.mean(axis=0)
        for number in range(150)
    ]
    errors = (np.array(found) - [1e4, 0, 0]) / 1e4
    floor = 1e-5
    assert np.isclose(errors[:, 0].std(), scale_ppm * 1e-6, rtol=0.2, atol=floor)
    assert np.isclose(errors[:, 1:].std(), np.radians(misalignment_arcsec / 3600), rtol=0.2, atol=floor)


def test_the_altimeter_is_drawn_recorded_or_absent():
    noise = np.array([draw(number=number).instruments.range_m - 800 for number in range(20)])
    assert np.isclose(noise.std(), 0.2 + 0.0005 * 800, rtol=0.05)
    np.testing.assert_array_equal(draw(altimeter="recorded").instruments.range_m, STILL.range_m)
    absent = draw(altimeter="none").instruments
    assert len(absent.range_time_s) == len(absent.range_m) == 0


def test_a_star_tracker_measures_attitudes_with_outages():
    stars = draw(star_tracker_hz=2.0, star_tracker_outage_s=10.0).instruments.star_tracker
    np.testing.assert_allclose(stars.time_s, np.arange(1, 61) / 2)
    dark = np.isnan(stars.rotation_body_from_site).all(axis=(1, 2))
    assert dark.sum() in (19, 20, 21)
    assert (np.diff(np.flatnonzero(dark)) == 1).all()
    turns = np.concatenate(
        [
            rotation_vectors(draw(number=number, star_tracker_hz=2.0).instruments.star_tracker.rotation_body_from_site)
            for number in range(20)
        ]
    )
    np.testing.assert_allclose(np.degrees(turns.std(axis=0)) * 3600, [10, 10, 60], rtol=0.1)
    assert draw().instruments.star_tracker is None


def test_a_doppler_lidar_measures_speeds_along_three_beams():
    lidar = draw(doppler_hz=5.0).instruments.doppler_lidar
    assert len(lidar.time_s) == len(lidar.beams) == 3 * 150
    assert lidar.errors.step_s == 0.2
    np.testing.assert_allclose(np.degrees(np.arccos(-DOPPLER_BEAMS[:, 2])), 22.5)
    errors = [beam.speed_mps - VELOCITY_MPS @ beam.direction_in_body for beam in lidar.beams]
    assert np.isclose(np.std(errors), 0.02, rtol=0.15)
    assert abs(np.mean(errors)) < 0.005
    assert all(np.isnan(beam.range_m) for beam in lidar.beams)


def test_true_motion_follows_a_turning_lander():
    """A constant rotation about the vertical, and a constant acceleration, from frame to frame."""
    rate, acceleration = np.array([0, 0, 0.2]), np.array([0.5, -0.3, 0.4])
    frames = np.arange(0.0, 6.0) * 1.303
    mounting = matrix_from_rotation_vector(np.array([0.4, -0.2, 1.0]))

    def attitude(t):
        return matrix_from_rotation_vector(rate * t)

    true = [Pose(np.array([0.0, 0.0, 1000.0]), mounting @ attitude(t).T) for t in frames]
    seen = dataclasses.replace(descent(6), time_s=frames, true=true)
    time_s = 0.01 * np.arange(1, 701)
    middle = time_s - 0.005
    force = np.array([attitude(t).T @ (acceleration - gravity_mps2(1000.0)) for t in middle])
    measured = Increments(time_s, np.full(700, 0.01), np.tile(rate, (700, 1)), force)
    velocities = VELOCITY_MPS + frames[:, None] * acceleration
    motion = true_motion(seen, velocities, measured, mounting)
    np.testing.assert_allclose(motion.velocity_mps, VELOCITY_MPS + time_s[:, None] * acceleration, atol=2e-3)
    np.testing.assert_allclose(motion.rotation_site_from_body, [attitude(t) for t in time_s], atol=1e-6)
    few = motion.at_rate(2.0)
    np.testing.assert_allclose(few.time_s, np.arange(1, 15) / 2)


def test_a_nominal_draw_leaves_detections():
    assert draw().descent is DESCENT


@pytest.mark.parametrize("settings", [{"scenario": "outage"}, {"detections_outage_s": 10.0}])
def test_an_outage_takes_ten_seconds_of_detections(settings):
    found = draw(**settings)
    blind = [len(own) == 0 for own in found.descent.sightings]
    assert sum(blind) == 10
    first = blind.index(True)
    assert all(blind[first : first + 10])
    assert all(found.descent.sightings[k] is DESCENT.sightings[k] for k in range(31) if not blind[k])


def test_outages_begin_anywhere_and_have_their_length():
    time_s, rng = np.arange(0, 60, 0.1), np.random.default_rng(0)
    starts = []
    for _ in range(300):
        dark = outage(time_s, 60.0, 12.0, rng)
        assert dark.sum() in (119, 120, 121)
        starts.append(time_s[dark.argmax()])
    assert min(starts) < 1 and max(starts) > 47
    assert outage(time_s, 60.0, 500.0, rng).all()
    assert not outage(time_s, 60.0, 0.0, rng).any()


def test_ranges_are_missing_in_an_outage_of_the_altimeter():
    found = draw(altimeter_outage_s=7.0).instruments.range_m
    assert np.isnan(found).sum() in (69, 70, 71)


def test_a_wrong_prior_is_300_m_off_over_ground():
    found = draw("wrong-prior")
    assert np.isclose(np.hypot(*found.start_error[:2]), 300)
    assert abs(found.start_error[2]) < 250


def test_half_of_the_detections_are_false():
    found = draw("false-detections")
    for before, after in zip(DESCENT.sightings, found.descent.sightings, strict=True):
        assert len(after) == 2 * len(before)
        np.testing.assert_array_equal(np.sort(after.radius_px), np.sort(np.tile(before.radius_px, 2)))
        true = (after.centre_px[:, None] == before.centre_px).all(axis=2).any(axis=1)
        assert true.sum() == len(before)
        assert (np.diff(after.radius_px) <= 0).all()
