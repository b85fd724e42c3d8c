import numpy as np
import pytest

from perilune_shared.camera import Camera
from perilune_shared.descent import ROTATION_CAMERA_FROM_BODY
from perilune_shared.frames import matrix_from_rotation_vector
from perilune_train.navigate.data import Descent
from perilune_train.navigate.metrics import mean_motion, mean_motion_at_step, motion_errors, summary


def _descent(steps_m, name="t0"):
    """A level camera that moves by the given steps in O_L."""
    positions = np.cumsum([[0, 0, 1000.0], *steps_m], axis=0)
    n = len(positions)
    return Descent(
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
    training = [_descent([[0, 0, -10], [0, 0, -30]]), _descent([[2, 0, -20], [0, 0, -40], [0, 4, -50]])]
    # In O_C: x as x_L, y and z against y_L and z_L.
    translation, rotation = mean_motion(training, _descent([[0, 0, -1]] * 2))
    np.testing.assert_allclose(translation, [[0.4, -0.8, 30]] * 2)
    np.testing.assert_allclose(rotation, [np.eye(3)] * 2, atol=1e-12)
    translation, _ = mean_motion_at_step(training, _descent([[0, 0, -1]] * 4))
    np.testing.assert_allclose(translation, [[1, 0, 15], [0, 0, 35], [0, -4, 50], [0, -4, 50]])


def test_errors_and_drift_by_hand():
    descent = _descent([[0, 0, -10], [0, 0, -10]])
    translation, rotation = (values.copy() for values in descent.motion)
    translation += [[3, 0, 4], [3, 0, 0]]
    rotation[1] = matrix_from_rotation_vector(np.radians([0.3, 0, 0.4]))
    errors = motion_errors([descent], [(translation, rotation)])
    np.testing.assert_allclose(errors["position_error_m"], [5, 3])
    np.testing.assert_allclose(errors["orientation_error_deg"], [0, 0.5], atol=1e-9)
    np.testing.assert_allclose(errors["error_z_deg"], [0, 0.4], atol=1e-6)
    # The offsets add up in O_L, whose z is against z_C: (3, 0, -4), then (6, 0, -4).
    np.testing.assert_allclose(errors["drift_m"], [5, np.sqrt(52)])
    figures = summary(errors)
    assert figures["position_rmse_m"] == pytest.approx(np.sqrt((25 + 9) / 2))
    assert figures["position_rmse_x_m"] == pytest.approx(3)
    assert figures["orientation_rmse_deg"] == pytest.approx(0.5 / np.sqrt(2))
    assert figures["drift_final_m"] == pytest.approx(np.sqrt(52))
    assert figures["drift_rms_m"] == pytest.approx(np.sqrt((25 + 52) / 2))


def test_a_rotation_error_bends_the_dead_reckoned_path():
    descent = _descent([[0, 0, -10], [0, 0, -10]])
    translation, rotation = (values.copy() for values in descent.motion)
    rotation[0] = matrix_from_rotation_vector([0, np.pi / 2, 0]) @ rotation[0]
    drift = motion_errors([descent], [(translation, rotation)])["drift_m"].to_numpy()
    np.testing.assert_allclose(drift, [0, np.hypot(10, 10)], atol=1e-9)
