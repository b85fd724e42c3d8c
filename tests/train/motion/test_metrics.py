import numpy as np
import pytest

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.metrics.baselines import mean_motion, mean_motion_at_step
from perilune_train.motion.metrics.errors import motion_errors, normalised_errors, summary, summary_spreads


def _trajectory(steps_m, name="t0"):
    """A level camera that moves by the given steps in O_L."""
    positions = np.cumsum([[0, 0, 1000.0], *steps_m], axis=0)
    n = len(positions)
    return Trajectory(
        ("s", name),
        "test",
        np.zeros((n, 4, 4), np.uint8),
        Camera(4, 4, 4, 4, 2, 2),
        positions,
        np.stack([ROTATION_CAMERA_FROM_BODY] * n),
        positions,
        ROTATION_CAMERA_FROM_BODY,
    )


def test_baselines_by_hand():
    training = [_trajectory([[0, 0, -10], [0, 0, -30]]), _trajectory([[2, 0, -20], [0, 0, -40], [0, 4, -50]])]
    # In O_C: x as x_L, y and z against y_L and z_L.
    translation, rotation = mean_motion(training, _trajectory([[0, 0, -1]] * 2))
    np.testing.assert_allclose(translation, [[0.4, -0.8, 30]] * 2)
    np.testing.assert_allclose(rotation, [np.eye(3)] * 2, atol=1e-12)
    translation, _ = mean_motion_at_step(training, _trajectory([[0, 0, -1]] * 4))
    np.testing.assert_allclose(translation, [[1, 0, 15], [0, 0, 35], [0, -4, 50], [0, -4, 50]])


def test_errors_and_drift_by_hand():
    trajectory = _trajectory([[0, 0, -10], [0, 0, -10]])
    translation, rotation = (values.copy() for values in trajectory.motion)
    translation += [[3, 0, 4], [3, 0, 0]]
    rotation[1] = matrix_from_rotation_vector(np.radians([0.3, 0, 0.4]))
    errors = motion_errors([trajectory], [(translation, rotation)])
    np.testing.assert_allclose(errors["position_error_m"], [5, 3])
    np.testing.assert_allclose(errors["orientation_error_deg"], [0, 0.5], atol=1e-9)
    np.testing.assert_allclose(errors["error_z_deg"], [0, 0.4], atol=1e-6)
    # The offsets add up in O_L, whose z is against z_C: (3, 0, -4), then (6, 0, -4).
    np.testing.assert_allclose(errors["drift_m"], [5, np.sqrt(52)])
    figures = summary(errors)
    # Errors (3, 0, 4) and (3, 0, 0): two lengths, six components.
    assert figures["position_rmse_vector_m"] == pytest.approx(np.sqrt((25 + 9) / 2))
    assert figures["position_rmse_per_component_m"] == pytest.approx(np.sqrt((9 + 0 + 16 + 9 + 0 + 0) / 6))
    assert figures["position_rmse_x_m"] == pytest.approx(3)
    assert figures["orientation_rmse_angle_deg"] == pytest.approx(0.5 / np.sqrt(2))
    assert figures["orientation_rmse_per_component_deg"] == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 6))
    assert not {"position_rmse_m", "orientation_rmse_deg"} & set(figures)
    assert figures["drift_final_m"] == pytest.approx(np.sqrt(52))
    assert figures["drift_rms_m"] == pytest.approx(np.sqrt((25 + 52) / 2))


def test_normalised_errors_by_hand():
    trajectory = _trajectory([[0, 0, -10], [0, 0, -10]])
    translation, rotation = (values.copy() for values in trajectory.motion)
    translation[0] += [3, 0, 4]
    rotation[1] = matrix_from_rotation_vector([0.003, 0, 0]) @ rotation[1]
    covariance = np.stack([np.diag([1e-6] * 3 + [4.0, 1.0, 16.0]), np.diag([1e-6] * 3 + [1.0] * 3)])
    found = normalised_errors(trajectory, (translation, rotation), covariance)
    # (3 / 2)^2 + (4 / 4)^2; (0.003 / 0.001)^2.
    np.testing.assert_allclose(found, [3.25, 9], rtol=1e-4)
    errors = motion_errors([trajectory], [(translation, rotation)], [covariance])
    assert summary(errors)["normalised_error_squared_mean"] == pytest.approx(6.125, rel=1e-4)


def errors_of(n_trajectories):
    """Trajectories of two steps, the k-th off by k metres in x in every step."""
    trajectories = [_trajectory([[0, 0, -10]] * 2, f"t{k}") for k in range(n_trajectories)]
    motions = [(d.motion[0] + [k, 0, 0], d.motion[1]) for k, d in enumerate(trajectories)]
    return motion_errors(trajectories, motions)


def test_an_interval_needs_five_trajectories():
    few = summary_spreads(errors_of(4))["position_rmse_vector_m"]
    assert few.interval is None and few.unit == "trajectory"
    assert few.by_unit == pytest.approx({"s/t0": 0, "s/t1": 1, "s/t2": 2, "s/t3": 3})
    enough = summary_spreads(errors_of(5))["position_rmse_vector_m"]
    low, high = enough.interval
    assert 0 < low < summary(errors_of(5))["position_rmse_vector_m"] < high < 4 and enough.by_unit == {}


def test_a_rotation_error_bends_the_dead_reckoned_path():
    trajectory = _trajectory([[0, 0, -10], [0, 0, -10]])
    translation, rotation = (values.copy() for values in trajectory.motion)
    rotation[0] = matrix_from_rotation_vector([0, np.pi / 2, 0]) @ rotation[0]
    drift = motion_errors([trajectory], [(translation, rotation)])["drift_m"].to_numpy()
    np.testing.assert_allclose(drift, [0, np.hypot(10, 10)], atol=1e-9)
