import numpy as np
import pytest

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.motion import draw_motion
from perilune_shared.errors import UserError

FLIGHT = FlightConfig(correlation_time_s=6.0, max_perturbation_mps2=1.5, attitude_sigma_deg=1.0)
TIMES = np.arange(0, 10, 0.01)


def test_velocity_and_acceleration_are_the_derivatives_of_the_position():
    position, velocity, acceleration = draw_motion(FLIGHT, 3).path_at(TIMES)
    assert np.allclose(np.gradient(position, TIMES, axis=0)[1:-1], velocity[1:-1], atol=1e-4)
    assert np.allclose(np.gradient(velocity, TIMES, axis=0)[1:-1], acceleration[1:-1], atol=1e-4)


def test_no_perturbation_exceeds_the_limit():
    free = FLIGHT.model_copy(update={"max_perturbation_mps2": None})
    limited, unlimited = ([_largest_mps2(draw_motion(config, seed)) for seed in range(40)] for config in (FLIGHT, free))
    assert max(limited) <= 1.5 * 1.01
    assert max(unlimited) > 1.5
    assert all(a == b for a, b in zip(limited, unlimited, strict=True) if b <= 1.49), "those within it stay the same"


def _largest_mps2(motion):
    acceleration = motion.path_at(np.arange(0, 65, 0.1))[2] - np.array(motion.nominal.acceleration_mps2)
    return np.linalg.norm(acceleration, axis=1).max()


@pytest.mark.slow
def test_a_limit_that_no_draw_keeps_is_an_error():
    impossible = FLIGHT.model_copy(update={"max_perturbation_mps2": 1e-3})
    with pytest.raises(UserError, match="max_perturbation_mps2"):
        draw_motion(impossible, 1)
    with pytest.raises(ValueError, match=r"at least 1\.15"):
        FlightConfig(correlation_time_s=6.0, max_perturbation_mps2=1.0)


def test_the_attitude_may_have_its_own_correlation_time():
    slow = FLIGHT.model_copy(update={"attitude_correlation_time_s": 60.0})
    fast, calm = (draw_motion(config, 5).attitude_process.at(TIMES)[1].std() for config in (FLIGHT, slow))
    assert calm < fast / 5
    assert np.array_equal(draw_motion(slow, 5).path_at(TIMES)[0], draw_motion(FLIGHT, 5).path_at(TIMES)[0])
