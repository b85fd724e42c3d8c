import numpy as np

from perilune_shared.geometry.nominal_trajectory import NominalTrajectory

TRAJECTORY = NominalTrajectory.parabola(1500, 200, 500, 90.0, 65.0)


def test_it_starts_east_of_the_site_and_ends_above_it():
    assert np.allclose(TRAJECTORY.position_at(0.0), [-500, 0, 1500])
    assert np.allclose(TRAJECTORY.position_at(65.0), [0, 0, 200])


def test_it_ends_with_vertical_velocity():
    assert np.allclose(TRAJECTORY.velocity_at(65.0), [0, 0, -20])


def test_velocity_is_the_derivative_of_position():
    t, h = np.linspace(1, 60, 7), 1e-4
    numeric = (TRAJECTORY.position_at(t + h) - TRAJECTORY.position_at(t - h)) / (2 * h)
    assert np.allclose(numeric, TRAJECTORY.velocity_at(t), atol=1e-5)


def test_the_path_is_a_parabola():
    x, _, z = TRAJECTORY.position_at(np.linspace(0, 65, 50)).T
    assert np.allclose(x, -500 * ((z - 200) / 1300) ** 2)
