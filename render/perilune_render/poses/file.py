"""Read poses from a file in the format CSV, Parquet, TUM, EuRoC or KITTI.

The columns of TUM are `timestamp tx ty tz qx qy qz qw`; KITTI has 3 x 4 matrices.

The frame of the positions is stated in the file: in text files by a comment line `# frame: O_L` above the first pose
(in CSV above the column names), in Parquet by the key `frame` of the metadata.

- `O_L`: x_m, y_m, z_m of the landing site's frame.
- `O_W`: x_m, y_m, z_m along the axes of O_L. `# origin_m: x y z` states the origin, the lander's first position in O_L.
- `selenographic`: latitude_deg, longitude_deg, and height_m above the plane of O_L.

Attitudes are quaternions rotation_camera_from_site (w, x, y, z) in the columns qw, qx, qy, qz, like `rotation_wxyz` in
a manifest. `# rotation: site_from_camera` states the opposite direction, which TUM, EuRoC and KITTI files always have.
If the camera's axes are not x right, y down, z forward, a comment line states the axes that point right, down and
forward: by name (`# camera_axes: blender`) or one by one (`# camera_axes: x,-y,-z`).

`# site: latitude longitude`, degrees, is optional; poses of a site that differs from the scene's are rejected.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_render.flight.pose_checks import LARGEST_MPS, LARGEST_RADPS
from perilune_render.poses.attitudes import Attitudes
from perilune_render.poses.axes import camera_axes
from perilune_render.poses.table import (
    POSITION,
    ROTATION,
    SELENOGRAPHIC,
    SITE_FROM_CAMERA,
    SUN,
    TIME,
    TRAJECTORY,
    TURN,
    VELOCITY,
    PoseTable,
    read_pose_table,
)
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, site_from_selenographic

FRAMES = {"O_L": POSITION, "O_W": POSITION, "selenographic": SELENOGRAPHIC}
"""Columns of the position in each frame."""
_DIRECTIONS = ("camera_from_site", SITE_FROM_CAMERA)
_LENGTH_TOLERANCE = 0.01
"""Largest deviation of a quaternion's length from 1 that rounded digits can explain."""
_LARGEST_M = 1e6
"""Largest distance of a camera from the site, metres."""
_SAME_SITE_M = 0.1
"""Smallest distance between the site in a file and the scene's site at which the file is rejected, metres."""


@dataclass(frozen=True, slots=True)
class GivenPoses:
    """Poses of N frames, in O_L."""

    time_s: Array
    """Time of each frame, seconds (N,)."""
    position_m: Array
    """Position of the camera, metres (N, 3)."""
    rotation_wxyz: Array
    """rotation_camera_from_site, unit quaternions (N, 4) with w >= 0."""
    velocity_mps: Array
    """Velocity of the camera, metres per second (N, 3); 0 if the file has no velocities."""
    sun_deg: Array | None
    """Azimuth, clockwise from north, and elevation of the Sun, degrees (N, 2); None if the file has no Sun."""
    trajectory: np.ndarray
    """Number of the trajectory of each frame, from 0, non-decreasing (N,)."""
    angular_velocity_radps: Array | None = None
    """Angular velocity of the camera, O_C, radians per second (N, 3); None if not in the file."""

    line: np.ndarray | None = None
    """Line of each pose in the file, from 1 (N,); None for a file without lines, whose rows count from 0."""
    attitudes: Attitudes | None = None
    """The attitudes as in the file; None without a file."""

    def __len__(self) -> int:
        return len(self.time_s)

    def origin(self, index: int) -> str:
        """Line or row of a pose in its file, for messages."""
        return f"row {index}" if self.line is None else f"line {self.line[index]}"

    @property
    def sha256(self) -> str:
        """SHA-256 of all values, hexadecimal."""
        digest = hashlib.sha256()
        sun = np.empty((0, 2)) if self.sun_deg is None else self.sun_deg
        turn = np.empty((0, 3)) if self.angular_velocity_radps is None else self.angular_velocity_radps
        for values in (self.time_s, self.position_m, self.rotation_wxyz, self.velocity_mps, sun, self.trajectory, turn):
            digest.update(np.ascontiguousarray(values, np.float64).tobytes())
        return digest.hexdigest()


def read_poses(path: Path, latitude_deg: float, longitude_deg: float, axes: str | None = None) -> GivenPoses:
    """Read the poses of a file, for a site at these coordinates.

    `axes` is the option `--camera-axes`, for files without the line `# camera_axes`. If both are present, they must be
    equal. Raises UserError with the first faulty line.
    """
    table = read_pose_table(path)
    columns, stated = table.columns, table.stated
    frame = stated.get("frame")
    if frame not in FRAMES:
        line = "the metadata key frame" if table.format == "Parquet" else "the comment line `# frame: O_L`"
        found = f"not stated in this {table.format} file" if frame is None else frame
        raise UserError(path, "frame", found, f"{line}, with one of {', '.join(FRAMES)}")
    _check_site(path, stated.get("site"), latitude_deg, longitude_deg)
    if not columns.n_rows:
        raise UserError(path, "poses", 0, "at least one")
    position = _vectors(table, FRAMES[frame])
    if frame == "selenographic":
        x, y = site_from_selenographic(position[:, 0], position[:, 1], latitude_deg, longitude_deg)
        position = np.stack([x, y, position[:, 2]], axis=1)
    if frame == "O_W":
        position = position + _origin(path, stated)
    _refuse(
        table,
        (np.abs(position) > _LARGEST_M).any(axis=1),
        "position",
        lambda row: f"{np.abs(position[row]).max():.3g} m from the site",
        f"at most {_LARGEST_M:.0f} m",
    )
    trajectory = _trajectories(table)
    time = columns.finite(TIME)
    late = np.concatenate([[False], (np.diff(time) <= 0) & (np.diff(trajectory) == 0)])
    _refuse(
        table, late, TIME, lambda row: f"{table.time_text(row)} after {table.time_text(row - 1)}", "increasing times"
    )
    velocity = _motion(table, "velocity", VELOCITY, LARGEST_MPS, "m/s")
    turn = _motion(table, "angular velocity", TURN, LARGEST_RADPS, "rad/s")
    sun = _vectors(table, SUN) if SUN[0] in columns else None
    if sun is not None:
        low = (sun[:, 1] <= 0) | (sun[:, 1] > 90)
        expected = "above 0 (the horizon), at most 90 degrees"
        _refuse(table, low, SUN[1], lambda row: f"{sun[row, 1]:g}", expected)
    velocity = np.zeros((columns.n_rows, 3)) if velocity is None else velocity
    attitudes = _attitudes(table, _axes(path, stated.get("camera_axes"), axes))
    if turn is not None and not np.array_equal(attitudes.axes, np.eye(3)):
        turn = turn @ attitudes.axes.T
    rotation = attitudes.rotation_wxyz
    return GivenPoses(time, position, rotation, velocity, sun, trajectory, turn, columns.lines, attitudes)


def _refuse(table: PoseTable, wrong: np.ndarray, field: str, found: Callable[[int], str], expected: str) -> None:
    """Raise UserError for the first true value of `wrong` (N,); `found` returns a text for its index."""
    if wrong.any():
        row = int(np.argmax(wrong))
        raise UserError(*table.columns.at(row, field), found(row), expected)


def _vectors(table: PoseTable, names: tuple[str, ...]) -> Array:
    """Columns as an array (N, k). Raises UserError for a value that is not a finite number."""
    return np.stack([table.columns.finite(name) for name in names], axis=1)


def _axes(path: Path, stated: str | None, given: str | None) -> Array:
    """The rotation (3, 3) from the camera's axes to right, down, forward.

    Raises UserError for invalid axes, or if file and option state different axes.
    """
    known = [camera_axes(text, where) for text, where in ((stated, path), (given, "--camera-axes")) if text is not None]
    if len(known) == 2 and not np.array_equal(known[0], known[1]):
        raise UserError("--camera-axes", "", given, f"{stated}, as {path} states")
    return known[0] if known else np.eye(3)


def _motion(table: PoseTable, field: str, names: tuple[str, ...], largest: float, unit: str) -> Array | None:
    """Vectors (N, 3) with a length of at most `largest`; None if the file has no such columns."""
    if names[0] not in table.columns:
        return None
    values = _vectors(table, names)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(values, axis=1)
    _refuse(table, length > largest, field, lambda row: f"{length[row]:.4g} {unit}", f"at most {largest:g} {unit}")
    return values


def _check_site(path: Path, stated: str | None, latitude_deg: float, longitude_deg: float) -> None:
    """Raise UserError if a file states a site that differs from the scene's."""
    if stated is None:
        return
    try:
        latitude, longitude = (float(word) for word in stated.replace(",", " ").split())
        x, y = site_from_selenographic(latitude, longitude, latitude_deg, longitude_deg)
        off_m = float(np.hypot(x, y))
    except ValueError:
        off_m = np.nan
    if not off_m < _SAME_SITE_M:
        expected = f"{latitude_deg:.6f} {longitude_deg:.6f}, latitude and longitude of the scene's site"
        raise UserError(path, "site", stated, expected)


def _origin(path: Path, stated: dict[str, str]) -> Array:
    words = stated.get("origin_m", "").replace(",", " ").split()
    try:
        origin = np.array([float(word) for word in words])
    except ValueError:
        origin = np.empty(0)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        expected = "`# origin_m: x y z`, the origin of O_W in O_L, metres"
        raise UserError(path, "origin_m", stated.get("origin_m", "not stated"), expected)
    return origin


def _attitudes(table: PoseTable, axes: Array) -> Attitudes:
    """The attitudes of a table. Raises UserError for a quaternion whose length is not 1."""
    direction = table.stated.get("rotation", _DIRECTIONS[0])
    if direction not in _DIRECTIONS:
        raise UserError(table.columns.path, "rotation", direction, " or ".join(_DIRECTIONS))
    q = _vectors(table, ROTATION)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(q, axis=1)
    _refuse(
        table,
        ~(np.abs(length - 1) <= _LENGTH_TOLERANCE),
        "quaternion",
        lambda row: f"length {length[row]:.4g}",
        "a unit quaternion qw, qx, qy, qz",
    )
    return Attitudes(q / length[:, None], direction == SITE_FROM_CAMERA, table.format == "TUM", axes)


def _trajectories(table: PoseTable) -> np.ndarray:
    """Number (N,) of each pose's trajectory, from the column `trajectory`.

    Raises UserError if the poses of a trajectory are not consecutive.
    """
    if TRAJECTORY not in table.columns:
        return np.zeros(table.columns.n_rows, int)
    names = table.columns.texts(TRAJECTORY)
    begins = np.concatenate([[True], names.codes[1:] != names.codes[:-1]])
    again = np.zeros(len(names), bool)
    _, first = np.unique(names.codes[begins], return_index=True)
    repeated = np.ones(int(begins.sum()), bool)
    repeated[first] = False
    again[begins] = repeated
    expected = "the poses of a trajectory one after another"
    _refuse(table, again, TRAJECTORY, lambda row: f"{names[row]} again", expected)
    return np.cumsum(begins) - 1
