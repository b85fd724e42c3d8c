import numpy as np
import pytest
from tests.sampling import every

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.instruments import GRADES, measured, true_increments
from perilune_render.flight.motion import draw_motion
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_shared.geometry.gravity import gravity_mps2

FLIGHT = FlightConfig(correlation_time_s=6.0, attitude_sigma_deg=1.0)
HOUR_S = 3600.0


def test_integrated_without_errors_they_give_the_motion():
    motion, ends = draw_motion(FLIGHT, 4), np.array([0.0, 65.0])
    true = true_increments(motion, 100.0)
    rotation, last_rotation = motion.rotation_site_from_body_at(ends)
    (position, last_position), (velocity, last_velocity), _ = motion.path_at(ends)
    for w, f in zip(true.angular_rate_radps, true.specific_force_mps2, strict=True):
        middle = rotation @ matrix_from_rotation_vector(w * 0.01 / 2)
        acceleration = middle @ f + gravity_mps2(position[2])
        position = position + velocity * 0.01 + acceleration * 0.01**2 / 2
        velocity = velocity + acceleration * 0.01
        rotation = rotation @ matrix_from_rotation_vector(w * 0.01)
    assert np.allclose(rotation, last_rotation, atol=1e-9)
    assert np.linalg.norm(position - last_position) < 0.01
    assert np.linalg.norm(velocity - last_velocity) < 1e-3


@pytest.mark.parametrize("grade", every(3, GRADES))
def test_errors_have_the_stated_sizes(grade):
    true, errors = true_increments(draw_motion(FLIGHT, 4), 100.0), GRADES[grade]
    units = [measured(true, grade, seed) for seed in range(120)]
    for name, bias, walk, unit in (
        ("angular_rate_radps", errors.gyro_bias_deg_per_h, errors.angular_random_walk_deg, np.radians(1)),
        ("specific_force_mps2", errors.accelerometer_bias_mg, errors.velocity_random_walk_mps, None),
    ):
        error = np.stack([getattr(one, name) for one in units]) - getattr(true, name)
        noise = np.std(np.diff(error, axis=1)) / np.sqrt(2)
        per_bias, per_walk = (unit / HOUR_S, unit) if unit else (9.80665e-3, 1.0)
        assert np.isclose(noise, walk * per_walk / np.sqrt(HOUR_S) / np.sqrt(0.01), rtol=0.02)
        # The mean over the trajectory has the noise's own error too.
        expected = np.hypot(bias * per_bias, noise / np.sqrt(6500))
        assert np.isclose(error.mean(axis=1).std(), expected, rtol=0.2)


def test_grades_and_seeds_differ_and_repeat():
    true = true_increments(draw_motion(FLIGHT, 4), 100.0)
    one, same, other = (measured(true, "tactical", seed).angular_rate_radps for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert np.abs(one - other).max() > 1e-5
    assert np.abs(measured(true, "navigation", 1).angular_rate_radps - one).max() > 1e-5


def test_intervals_cover_the_trajectory():
    config = FLIGHT.model_copy(update={"duration_s": 65.01})
    true = true_increments(draw_motion(config, 4), 30.0)
    assert np.isclose(true.interval_s.sum(), 65.01) and true.time_s[-1] == 65.01
    assert true.interval_s.min() > 0 and np.isclose(true.interval_s[0], 1 / 30)
