"""Read the estimates of the landing filter: the output of `perilune-train navigate fly` or `navigate trace`."""

from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from perilune_shared.dataset.manifest import Dataset, check_single
from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export.descents import Descent
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import RUN_TABLE
from perilune_shared.storage.tables.read import open_table

_POSE = ("time_s", "x_m", "y_m", "z_m", "rotation_w", "rotation_x", "rotation_y", "rotation_z")
_SIGMAS = tuple(f"sigma_{axis}_m" for axis in "xyz") + tuple(f"sigma_attitude_{axis}_deg" for axis in "xyz")
_ERRORS = (0, 1, 2, 6, 7, 8)
"""Errors of position and attitude in the filter's state (docs/reference/landing-filter.md)."""
_ELEMENTS = {(i, j): f"covariance_{i}_{j}" for i, j in combinations_with_replacement(_ERRORS, 2)}
_TIME_TOLERANCE_S = 1e-3


@dataclass(frozen=True, slots=True)
class Estimates:
    """Poses of the body in one descent, estimated at n times."""

    time_s: Array
    """Seconds since the first frame (n,), increasing."""
    position_m: Array
    """Position (n, 3), O_L, metres."""
    rotation_site_from_body: Array
    """Attitude (n, 3, 3)."""
    covariance: Array
    """Covariance (n, 6, 6) of position (m) and of a rotation about the axes of O_L (rad)."""


def read_estimates(path: Path, camera: CameraRecord, duration_s: float) -> Estimates:
    """Read `frames` of a trace (full covariance), or `estimates` of a flight (standard deviations only).

    `path` is the table, Parquet or CSV, or the folder that the command wrote. `duration_s` is the duration of the
    descent. Raises UserError if the table cannot be read, lacks columns, has other values than numbers, or belongs to
    another descent.
    """
    if any(camera.position_in_body_m):
        where = list(camera.position_in_body_m)
        raise UserError("--estimates", "camera.position_in_body_m", where, "[0, 0, 0]: the filter has no lever arm")
    names = ("frames.parquet", "frames.csv", "estimates.parquet", "estimates.csv")
    if path.is_dir():
        path = next((path / name for name in names if (path / name).is_file()), path / names[2])
    kinds: dict[str, Kind] = dict.fromkeys((*_POSE, *_SIGMAS, *_ELEMENTS.values()), "number")
    with open_table(path, RUN_TABLE) as opened:
        is_trace = "covariance_0_0" in opened.names
        columns = opened.read(kinds, (*_POSE, *(_ELEMENTS.values() if is_trace else _SIGMAS)))
    if not columns.n_rows:
        raise UserError(path, "rows", 0, "one row for each frame")
    time_s = columns.finite("time_s")
    columns.check("time_s", np.append(True, np.diff(time_s) > 0), "above the time of the row before")
    columns.check("time_s", (time_s > -_TIME_TOLERANCE_S) & (time_s < duration_s + _TIME_TOLERANCE_S),
                  f"a time of the descent, 0 to {duration_s:g} s: is this the flight of another descent?")  # fmt: skip
    position_m = np.column_stack([columns.finite(name) for name in _POSE[1:4]])
    rotation_wxyz = np.column_stack([columns.finite(name) for name in _POSE[4:]])
    columns.check("rotation_w", np.abs(np.linalg.norm(rotation_wxyz, axis=1) - 1) < 1e-3, "a unit quaternion")
    rotation = matrix_from_quaternion(rotation_wxyz)
    if is_trace:
        return Estimates(time_s, position_m, rotation, _of_trace(columns, rotation))
    # A flight states the attitude of the camera, with errors about the camera's axes.
    site_from_camera = rotation.swapaxes(1, 2)
    mounting = np.array(camera.rotation_camera_from_body)
    return Estimates(time_s, position_m, site_from_camera @ mounting, _of_flight(columns, site_from_camera))


def _of_trace(columns: Columns, rotation_site_from_body: Array) -> Array:
    """The covariance of a trace; its attitude error is about the body's axes: R_true = R exp(e)."""
    covariance = np.zeros((columns.n_rows, 6, 6))
    for (i, j), name in _ELEMENTS.items():
        row, column = _ERRORS.index(i), _ERRORS.index(j)
        values = columns.finite(name, 0.0) if i == j else columns.finite(name)
        covariance[:, row, column] = covariance[:, column, row] = values
    return _turned(covariance, rotation_site_from_body)


def _of_flight(columns: Columns, rotation_site_from_camera: Array) -> Array:
    sigmas = np.column_stack([columns.finite(name, 0.0) for name in _SIGMAS])
    sigmas[:, 3:] = np.radians(sigmas[:, 3:])
    return _turned(sigmas[:, :, None] ** 2 * np.eye(6), rotation_site_from_camera)


def _turned(covariance: Array, rotation: Array) -> Array:
    """Return covariances (n, 6, 6) with the attitude errors turned by rotations (n, 3, 3)."""
    turn = np.tile(np.eye(6), (len(covariance), 1, 1))
    turn[:, 3:, 3:] = rotation
    return turn @ covariance @ turn.swapaxes(1, 2)


def estimates_of(dataset: Dataset, descent: Descent, path: Path) -> Estimates:
    """Read the estimates of a descent as `read_estimates` does.

    Also raises UserError if the dataset has several cameras.
    """
    check_single(dataset)
    rows = dataset.table("trajectories", ["duration_s"], descent.scene_id, descent.trajectory_id)
    return read_estimates(path, dataset.info.camera, float(rows["duration_s"][0].as_py()))
