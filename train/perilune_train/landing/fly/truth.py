"""Read truth.csv, the true poses of the frames of a descent, and compute the errors of estimates."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, rotation_vectors
from perilune_shared.storage.tables.limits import POSES
from perilune_shared.storage.tables.read import read_table
from perilune_train.landing.fly.tables import column_names, nanoseconds_as_seconds, read_euroc

TRUTH_COLUMNS = ("time_s", "x_m", "y_m", "z_m", "rotation_w", "rotation_x", "rotation_y", "rotation_z")
_SAME_S = 1e-6


@dataclass(frozen=True, slots=True)
class Truth:
    """True poses of n frames."""

    position_m: Array
    """Positions of the camera (n, 3), O_L."""
    rotation_camera_from_site: Array
    """Attitudes (n, 3, 3)."""


def read_truth(path: Path, time_s: Array, rotation_camera_from_body: Array) -> Truth:
    """Read the true camera poses of frames at times (n,) from truth.csv or from an EuRoC file.

    An EuRoC file has poses of the body. These are interpolated, and `rotation_camera_from_body` (3, 3) converts them to
    poses of the camera. Raises UserError if the times do not fit the frames, or if a value is not a number.
    """
    if any("p_RS_R_x" in name for name in column_names(path, POSES)):
        return _of_euroc(path, time_s, rotation_camera_from_body)
    table = read_table(path, POSES, dict.fromkeys(TRUTH_COLUMNS, "number"))
    values = np.column_stack([table.finite(name) for name in TRUTH_COLUMNS])
    if len(values) != len(time_s) or (np.abs(values[:, 0] - time_s) > _SAME_S).any():
        raise UserError(path, "time_s", f"{len(values)} rows of other times", f"the times of the {len(time_s)} frames")
    length = np.linalg.norm(values[:, 4:], axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        row = int((np.abs(length - 1) > 1e-3).argmax())
        raise UserError(path, f"rotation_w: row {row}", f"a quaternion of length {length[row]:g}", "a unit quaternion")
    return Truth(values[:, 1:4], matrix_from_quaternion(values[:, 4:]))


def _of_euroc(path: Path, time_s: Array, rotation_camera_from_body: Array) -> Truth:
    """Interpolate the poses of the inertial unit in an EuRoC file at the times of the frames."""
    place, turn = (tuple(f"{kind}_{axis}" for axis in axes) for kind, axes in (("p_RS_R", "xyz"), ("q_RS", "xyzw")))
    table = read_euroc(path, POSES, {"timestamp": "integer", **dict.fromkeys((*place, *turn), "number")})
    own_s = nanoseconds_as_seconds(table)
    if len(own_s) < 2 or own_s[0] > time_s[0] or own_s[-1] < time_s[-1]:
        found = f"{own_s[0]:.6f} to {own_s[-1]:.6f} s" if len(own_s) else "no pose"
        raise UserError(path, "timestamp", found, f"the time of the frames, {time_s[0]:.6f} to {time_s[-1]:.6f} s")
    quaternions = np.column_stack([table.finite(name) for name in turn])
    table.check(turn[3], np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= 1e-3, "a unit quaternion")
    site_from_body = Slerp(own_s, Rotation.from_quat(quaternions))(time_s).as_matrix()
    position = np.column_stack([np.interp(time_s, own_s, table.finite(name)) for name in place])
    return Truth(position, rotation_camera_from_body @ np.swapaxes(site_from_body, 1, 2))


def with_errors_of(estimates: pd.DataFrame, truth: Truth | None) -> pd.DataFrame:
    """Add columns with the errors of estimated poses; row k belongs to frame k of `truth`.

    The position error is estimate minus truth (metres, O_L). The attitude error is the angle between both attitudes.
    """
    if truth is None:
        return estimates
    n = len(estimates)
    error = estimates[["x_m", "y_m", "z_m"]].to_numpy() - truth.position_m[:n]
    found = matrix_from_quaternion(estimates[[f"rotation_{axis}" for axis in "wxyz"]].to_numpy())
    turn = rotation_vectors(found @ np.swapaxes(truth.rotation_camera_from_site[:n], 1, 2))
    errors = {f"error_{axis}_m": error[:, k] for k, axis in enumerate("xyz")}
    return estimates.assign(**errors, error_attitude_deg=np.degrees(np.linalg.norm(turn, axis=1)))
