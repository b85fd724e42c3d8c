"""truth.csv: true poses of the frames of a descent, for errors beside the estimates."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, rotation_vectors
from perilune_train.navigate.fly.tables import read_numbers

TRUTH_COLUMNS = ("time_s", "x_m", "y_m", "z_m", "rotation_w", "rotation_x", "rotation_y", "rotation_z")
_SAME_S = 1e-6


@dataclass(frozen=True, slots=True)
class Truth:
    """True poses of n frames."""

    position_m: Array
    """Positions of the camera (n, 3), O_L."""
    rotation_camera_from_site: Array
    """Attitudes (n, 3, 3)."""


def read_truth(path: Path, time_s: Array) -> Truth:
    """Read truth.csv of frames at times (n,). Raises UserError if it has other times or a value that is no number."""
    values = read_numbers(path, TRUTH_COLUMNS)
    if len(values) != len(time_s) or (np.abs(values[:, 0] - time_s) > _SAME_S).any():
        raise UserError(path, "time_s", f"{len(values)} rows of other times", f"the times of the {len(time_s)} frames")
    length = np.linalg.norm(values[:, 4:], axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        row = int((np.abs(length - 1) > 1e-3).argmax())
        raise UserError(path, f"rotation_w: row {row}", f"a quaternion of length {length[row]:g}", "a unit quaternion")
    return Truth(values[:, 1:4], matrix_from_quaternion(values[:, 4:]))


def with_errors_of(estimates: pd.DataFrame, truth: Truth | None) -> pd.DataFrame:
    """Estimates of the first frames with their errors: estimate less truth, O_L, metres, and the angle between both."""
    if truth is None:
        return estimates
    n = len(estimates)
    error = estimates[["x_m", "y_m", "z_m"]].to_numpy() - truth.position_m[:n]
    found = matrix_from_quaternion(estimates[[f"rotation_{axis}" for axis in "wxyz"]].to_numpy())
    turn = rotation_vectors(found @ np.swapaxes(truth.rotation_camera_from_site[:n], 1, 2))
    errors = {f"error_{axis}_m": error[:, k] for k, axis in enumerate("xyz")}
    return estimates.assign(**errors, error_attitude_deg=np.degrees(np.linalg.norm(turn, axis=1)))
