import numpy as np

from perilune_render.config.dataset import FlightConfig
from perilune_render.flight.motion import SmoothProcess
from perilune_render.flight.trajectories import fly
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY

FLIGHT = FlightConfig(position_sigma_m=8.0, attitude_sigma_deg=0.5, correlation_time_s=3.0)


def test_without_perturbation_it_is_the_nominal_curve():
    flight = fly(FlightConfig(position_sigma_m=0, attitude_sigma_deg=0), 30, 1)
    assert np.allclose(flight.position_m, flight.nominal.position_at(flight.time_s))
    assert np.allclose(flight.rotation_camera_from_site, ROTATION_CAMERA_FROM_BODY)
    assert np.allclose(flight.position_m[0, 2], 1500) and np.allclose(flight.position_m[-1], [0, 0, 200])


def test_perturbations_have_the_asked_sizes():
    flights = [fly(FLIGHT, 40, seed) for seed in range(150)]
    offset = np.concatenate([f.position_m - f.nominal.position_at(f.time_s) for f in flights])
    assert np.allclose(offset.std(axis=0), 8, rtol=0.1) and np.allclose(offset.mean(axis=0), 0, atol=1)
    tilt = np.array([f.rotation_camera_from_site[10] @ ROTATION_CAMERA_FROM_BODY.T for f in flights])
    assert np.isclose(np.degrees(tilt[:, 2, 1]).std(), 0.5, rtol=0.2)


def test_perturbations_are_correlated_as_asked():
    value = SmoothProcess.draw([3.0] * 4, np.random.default_rng(2)).at(np.arange(0, 3000.0, 1.0))[0]
    for lag in (1, 3, 6):
        correlation = np.mean(value[lag:] * value[:-lag])
        assert abs(correlation - np.exp(-(lag**2) / 18)) < 0.15


def test_velocity_is_the_derivative():
    fine = fly(FLIGHT, 6501, 9)
    numeric = np.gradient(fine.position_m, fine.time_s, axis=0)
    assert np.abs(numeric - fine.velocity_mps)[5:-5].max() < 0.01


def test_rotations_are_rotations():
    rotations = fly(FLIGHT, 20, 3).rotation_camera_from_site
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3)) and np.allclose(np.linalg.det(rotations), 1)


def test_a_descent_follows_from_its_seed():
    assert np.array_equal(fly(FLIGHT, 20, 3).position_m, fly(FLIGHT, 20, 3).position_m)
    assert not np.allclose(fly(FLIGHT, 20, 3).position_m, fly(FLIGHT, 20, 4).position_m)
