import numpy as np

from perilune_render.config.dataset import FlightConfig, InstrumentsConfig
from perilune_render.flight.instruments import measure_ranges, measure_ranges_of_frames, range_to_ground_m
from perilune_render.flight.motion import draw_motion
from perilune_render.flight.trajectories import fly
from perilune_render.terrain.interpolation import value_at

CONFIG = InstrumentsConfig(range_rate_hz=10.0)


def test_the_beam_ends_on_the_ground(scene):
    motion, times = draw_motion(FlightConfig(attitude_sigma_deg=2.0), 7), np.linspace(0, 65, 200)
    position, beam = motion.path_at(times)[0], -motion.rotation_site_from_body_at(times)[:, :, 2]
    end = position + range_to_ground_m(scene, position, beam)[:, None] * beam
    assert np.allclose(end[:, 2], value_at(scene.height_m, scene.grid, end[:, 0], end[:, 1]), atol=0.01)


def test_a_beam_that_misses_the_terrain_has_no_range(scene):
    position = np.array([[0.0, 0.0, 500.0]] * 3)
    beams = np.array([[0, 0, 1.0], [np.sin(1.56), 0, -np.cos(1.56)], [0, 0, -1.0]])
    assert np.isnan(range_to_ground_m(scene, position, beams)).tolist() == [True, True, False]


def test_noise_grows_with_the_range(scene):
    motion = draw_motion(FlightConfig(), 7)
    times = measure_ranges(motion, scene, CONFIG, 65.0, 0).time_s
    assert len(times) == 651 and times[-1] == 65
    true_m = range_to_ground_m(scene, motion.path_at(times)[0], -motion.rotation_site_from_body_at(times)[:, :, 2])
    error = np.stack([measure_ranges(motion, scene, CONFIG, 65.0, s).range_m - true_m for s in range(200)])
    assert np.allclose(error.std(axis=0)[:100].mean(), 0.2 + 0.0005 * true_m[:100].mean(), rtol=0.05)
    assert np.allclose(error.std(axis=0)[-100:].mean(), 0.2 + 0.0005 * true_m[-100:].mean(), rtol=0.05)


def test_ranges_of_frames_are_along_the_cameras_axis_with_noise_of_their_own(scene):
    flight = fly(FlightConfig(attitude_sigma_deg=2.0), 20, 7)
    exact = InstrumentsConfig(range_rate_hz=1.0, range_sigma_m=0.0, range_sigma_share=0.0)
    found = measure_ranges_of_frames(flight, range(20), scene, exact, 5)
    end = flight.position_m + found.range_m[:, None] * flight.rotation_camera_from_site[:, 2]
    assert np.array_equal(found.time_s, flight.time_s)
    assert np.allclose(end[:, 2], value_at(scene.height_m, scene.grid, end[:, 0], end[:, 1]), atol=0.01)
    draws = [measure_ranges_of_frames(flight, range(20), scene, CONFIG, seed).range_m for seed in range(200)]
    error = np.stack(draws) - found.range_m
    assert np.allclose(error.std(axis=0).mean(), 0.2 + 0.0005 * found.range_m.mean(), rtol=0.05)
    later = measure_ranges_of_frames(flight, range(5, 25), scene, CONFIG, 0).range_m
    assert not np.allclose(later - found.range_m, error[0], atol=0.01)
