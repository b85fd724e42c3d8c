"""Rotations between frames, integrated from the gyroscope measurements of the table `inertial`."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_shared.geometry.inertial_grades import GRADES, HOUR_S, InertialGrade

_LATE_S = 1e-6
"""Tolerance, seconds, for gaps between measurements and at both ends of the trajectory."""


@dataclass(frozen=True, slots=True)
class GyroscopeTurns:
    """Measured rotations between consecutive frames of one trajectory."""

    rotation_c2_from_c1: Array
    """Rotations (n - 1, 3, 3)."""
    sigma_rad: Array
    """Standard deviation of each rotation, equal about all axes (n - 1,), radians, from the errors of the grade."""


def gyroscope_turns(
    dataset: Dataset, ids: tuple[str, str], grade: InertialGrade, time_s: Array, rotation_camera_from_body: Array
) -> GyroscopeTurns | None:
    """Rotations between the frames at times (n,) of a trajectory; None if it has no inertial unit of this grade.

    `ids` are scene_id and trajectory_id. Raises UserError if measurements are missing between the first and the last
    frame.
    """
    rows = dataset.table("inertial", ["grade", "time_s", "interval_s", "angular_rate_radps"], *ids).to_pandas()
    rows = rows[rows["grade"] == grade].sort_values("time_s")
    if rows.empty:
        return None
    ends, intervals = rows["time_s"].to_numpy(), rows["interval_s"].to_numpy()
    starts = ends - intervals
    if starts[0] > time_s[0] + _LATE_S or ends[-1] < time_s[-1] - _LATE_S or (starts[1:] > ends[:-1] + _LATE_S).any():
        where = f"{'/'.join(ids)}, inertial, {grade}"
        expected = f"no gap from {time_s[0]:g} to {time_s[-1]:g} s"
        raise UserError(dataset.store, where, f"{starts[0]:g} to {ends[-1]:g} s with gaps", expected)
    return turns_between(
        time_s, ends, intervals, np.stack(rows["angular_rate_radps"]), grade, rotation_camera_from_body
    )


def turns_between(
    time_s: Array,
    end_s: Array,
    interval_s: Array,
    angular_rate_radps: Array,
    grade: InertialGrade,
    rotation_camera_from_body: Array,
) -> GyroscopeTurns:
    """Rotations between times (n,), from mean angular rates (m, 3), O_B, over intervals (m,) that end at `end_s`."""
    attitude = [np.eye(3)]
    for rate, interval in zip(angular_rate_radps, interval_s, strict=True):
        attitude.append(attitude[-1] @ matrix_from_rotation_vector(rate * interval))
    number = np.clip(np.searchsorted(end_s, time_s), 0, len(end_s) - 1)
    since = time_s - (end_s - interval_s)[number]
    body = np.stack(
        [
            attitude[k] @ matrix_from_rotation_vector(angular_rate_radps[k] * part)
            for k, part in zip(number, since, strict=True)
        ]
    )
    # Turns multiply R_site_from_body from the right; the camera's rotation is C R_body_from_site.
    turn = np.swapaxes(body[1:], 1, 2) @ body[:-1]
    mounted = rotation_camera_from_body @ turn @ rotation_camera_from_body.T
    step_s, errors = np.diff(time_s), GRADES[grade]
    bias = np.radians(errors.gyro_bias_deg_per_h) / HOUR_S * step_s
    noise = np.radians(errors.angular_random_walk_deg) * np.sqrt(step_s / HOUR_S)
    return GyroscopeTurns(mounted, np.hypot(bias, noise))
