"""The star tracker and the Doppler lidar of a trajectory, and the axes of an inertial unit."""

import numpy as np
import pytest

from perilune_render.config.dataset import FlightConfig, InstrumentsConfig
from perilune_render.flight.instruments import measure_attitudes, measure_beams, measured, true_increments
from perilune_render.flight.motion import draw_motion
from perilune_render.streams import stream
from perilune_render.terrain.interpolation import value_at
from perilune_shared.geometry.frames import rotation_vectors
from perilune_shared.geometry.inertial_errors import drawn_axes, drawn_errors
from perilune_shared.geometry.inertial_grades import GRADES

FLIGHT = FlightConfig()
MOTION = draw_motion(FLIGHT, 4)


def test_attitudes_err_by_their_deviations_about_each_axis():
    config = InstrumentsConfig(star_tracker_rate_hz=50.0, star_tracker_sigma_arcsec=(10.0, 20.0, 60.0))
    attitudes = measure_attitudes(MOTION, config, 1)
    true = MOTION.rotation_site_from_body_at(attitudes.time_s)
    errors = rotation_vectors(np.swapaxes(true, 1, 2) @ np.swapaxes(attitudes.rotation_body_from_site, 1, 2))
    assert len(errors) == int(50 * MOTION.nominal.duration_s) + 1
    np.testing.assert_allclose(np.degrees(errors.std(axis=0)) * 3600, [10, 20, 60], rtol=0.1)
    np.testing.assert_allclose(np.degrees(errors.mean(axis=0)) * 3600, 0, atol=4)


def test_an_outage_removes_its_attitudes_and_changes_no_other():
    config = {"star_tracker_rate_hz": 5.0}
    whole = measure_attitudes(MOTION, InstrumentsConfig(**config), 1)
    config["star_tracker_outages_s"] = ({"low": 2.0, "high": 4.0}, {"low": 10, "high": 1e3})
    some = measure_attitudes(MOTION, InstrumentsConfig(**config), 1)
    seen = ((whole.time_s < 2) | (whole.time_s >= 4)) & (whole.time_s < 10)
    np.testing.assert_array_equal(some.time_s, whole.time_s[seen])
    np.testing.assert_array_equal(some.rotation_body_from_site, whole.rotation_body_from_site[seen])


def test_beams_measure_speed_and_distance_along_their_directions(scene):
    exact = {"doppler_speed_sigma_mps": 0.0, "doppler_range_sigma_m": 0.0}
    beams = measure_beams(MOTION, scene, InstrumentsConfig(doppler_rate_hz=2.0, doppler_beams=4, **exact), 1)
    np.testing.assert_allclose(beams.direction_in_body @ [0, 0, -1], np.cos(np.radians(22.5)))
    np.testing.assert_allclose(beams.direction_in_body.sum(axis=0)[:2], 0, atol=1e-12)
    position, velocity, _ = MOTION.path_at(beams.time_s)
    rotation = MOTION.rotation_site_from_body_at(beams.time_s)
    for direction, speed, distance in zip(beams.direction_in_body, beams.speed_mps, beams.range_m, strict=True):
        along = rotation @ direction
        seen = np.isfinite(distance)
        assert seen.sum() > 5
        np.testing.assert_allclose(speed[seen], (along * velocity).sum(axis=1)[seen])
        end = position + distance[:, None] * along
        height = value_at(scene.height_m, scene.grid, end[seen, 0], end[seen, 1])
        np.testing.assert_allclose(end[seen, 2], height, atol=0.01)
        assert not np.isfinite(speed[~seen]).any()


def test_noise_of_beams_has_its_deviations(scene):
    config = {"doppler_rate_hz": 100.0, "doppler_speed_sigma_mps": 0.05, "doppler_range_sigma_m": 3.0}
    noisy = measure_beams(MOTION, scene, InstrumentsConfig(**config), 1)
    config |= {"doppler_speed_sigma_mps": 0.0, "doppler_range_sigma_m": 0.0}
    exact = measure_beams(MOTION, scene, InstrumentsConfig(**config), 1)
    assert np.nanstd(noisy.speed_mps - exact.speed_mps) == pytest.approx(0.05, rel=0.1)
    assert np.nanstd(noisy.range_m - exact.range_m) == pytest.approx(3.0, rel=0.1)


def test_a_unit_with_scale_factors_measures_along_other_axes():
    true, errors = true_increments(MOTION, 20.0), GRADES["cubesat"]
    gyro, accelerometer = drawn_errors(errors, true.interval_s, stream(3, "inertial", "cubesat"))
    axes = drawn_axes(errors, stream(3, "inertial axes", "cubesat"))
    unit = measured(true, "cubesat", 3)
    np.testing.assert_allclose(unit.angular_rate_radps, true.angular_rate_radps @ axes[0].T + gyro, atol=1e-12)
    np.testing.assert_allclose(unit.specific_force_mps2, true.specific_force_mps2 @ axes[1].T + accelerometer)
    drawn = np.array([drawn_axes(errors, np.random.default_rng(seed)) for seed in range(300)]) - np.eye(3)
    diagonal = np.eye(3, dtype=bool)
    assert drawn[:, :, diagonal].std() == pytest.approx(1e-3, rel=0.1)
    assert drawn[:, :, ~diagonal].std() == pytest.approx(np.radians(200 / 3600), rel=0.1)
