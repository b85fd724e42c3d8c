import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.data.gyroscope import gyroscope_turns, turns_between


def _attitude(time_s):
    """A known motion about two axes: rotation_site_from_body."""
    return matrix_from_rotation_vector([0.02 * np.sin(0.7 * time_s), 0, 0]) @ matrix_from_rotation_vector(
        [0, 0.03 * time_s, 0.01 * np.cos(time_s)]
    )


def test_turns_are_those_of_the_attitude_at_times_between_measurements():
    step = 0.01
    ends = step * np.arange(1, 701)
    ends[-1] = 6.994  # a shorter last interval
    intervals = np.diff(ends, prepend=0.0)
    rates = np.stack(
        [
            rotation_vectors(_attitude(end - length).T @ _attitude(end)) / length
            for end, length in zip(ends, intervals, strict=True)
        ]
    )
    times = np.array([0.0, 0.3333, 2.005, 4.0, 6.994])
    found = turns_between(times, ends, intervals, rates, "tactical", ROTATION_CAMERA_FROM_BODY)
    cameras = np.stack([ROTATION_CAMERA_FROM_BODY @ _attitude(t).T for t in times])
    true = cameras[1:] @ np.swapaxes(cameras[:-1], 1, 2)
    assert np.abs(rotation_vectors(found.rotation_c2_from_c1 @ np.swapaxes(true, 1, 2))).max() < 1e-6


def test_standard_deviations_follow_the_grade():
    ends = np.arange(0.01, 10.005, 0.01)
    times = np.array([0.0, 1.0, 10.0])
    sigmas = {
        grade: turns_between(
            times, ends, np.full(len(ends), 0.01), np.zeros((len(ends), 3)), grade, np.eye(3)
        ).sigma_rad
        for grade in ("tactical", "navigation")
    }
    # Tactical: bias of 10 degrees per hour, 0.1 degrees per root hour.
    assert np.allclose(np.degrees(sigmas["tactical"]), [np.hypot(1 / 360, 0.1 / 60), np.hypot(9 / 360, 0.3 / 60)])
    assert (sigmas["navigation"] < sigmas["tactical"] / 10).all()


def test_frames_after_the_last_measurement_are_an_error_and_another_grade_is_none(dataset_nav):
    dataset = open_dataset(dataset_nav)
    row = dataset.table("trajectories").to_pylist()[0]
    ids, times = (row["scene_id"], row["trajectory_id"]), np.array([0.0, 2 * row["duration_s"]])
    with pytest.raises(UserError, match="no gap from 0 to 80 s"):
        gyroscope_turns(dataset, ids, "tactical", times, ROTATION_CAMERA_FROM_BODY)
    assert gyroscope_turns(dataset, ids, "navigation", times, ROTATION_CAMERA_FROM_BODY) is None
