"""Read poses from a file: CSV, Parquet, or TUM (`timestamp tx ty tz qx qy qz qw`).

The frame of the positions is stated in the file: in a CSV by a comment line `# frame: O_L` before the names of the
columns, in Parquet by the key `frame` of the metadata, in TUM by a comment line anywhere above the first pose.

- `O_L`: x_m, y_m, z_m of the landing site's frame.
- `O_W`: the same axes, with the origin at `# origin_m: x y z`, the lander's first position in O_L.
- `selenographic`: latitude_deg, longitude_deg, and height_m above the plane of O_L.

Attitudes are quaternions rotation_camera_from_site (w, x, y, z) in the columns qw, qx, qy, qz, as `rotation_wxyz` in a
manifest. `# rotation: site_from_camera` states the opposite direction; in a TUM file that is always so.

`# site: latitude longitude`, degrees, is optional; poses of another site than that of the scene are refused.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from perilune_render.flight.pose_checks import LARGEST_MPS, LARGEST_RADPS
from perilune_render.poses.table import SITE_FROM_CAMERA, read_table
from perilune_shared.config_errors import nearest
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, site_from_selenographic

FRAMES = {
    "O_L": ("x_m", "y_m", "z_m"),
    "O_W": ("x_m", "y_m", "z_m"),
    "selenographic": ("latitude_deg", "longitude_deg", "height_m"),
}
"""Columns of the position in each frame."""
_TIME, _ROTATION = ("time_s",), ("qw", "qx", "qy", "qz")
_VELOCITY, _SUN = ("vx_mps", "vy_mps", "vz_mps"), ("sun_azimuth_deg", "sun_elevation_deg")
_TURN = ("wx_radps", "wy_radps", "wz_radps")
_TRAJECTORY = "trajectory"
_DIRECTIONS = ("camera_from_site", SITE_FROM_CAMERA)
_MAX_POSES = 1_000_000
_LENGTH_TOLERANCE = 0.01
"""Largest deviation of a quaternion's length from 1 that rounding of its digits explains."""
_LARGEST_M = 1e6
_SAME_SITE_M = 0.1


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
    """Velocity of the camera, metres per second (N, 3); 0 where the file has none."""
    sun_deg: Array | None
    """Azimuth, clockwise from north, and elevation of the Sun, degrees (N, 2); None if the file has none."""
    trajectory: np.ndarray
    """Number of the trajectory of each frame, from 0, not descending (N,)."""
    angular_velocity_radps: Array | None = None
    """Angular velocity of the camera, O_C, radians per second (N, 3); None if the file has none."""

    line: np.ndarray | None = None
    """Line of each pose in the file, from 1 (N,); None if its poses have no lines but rows, from 0."""

    def __len__(self) -> int:
        return len(self.time_s)

    def origin(self, index: int) -> str:
        """The place of a pose in its file, for messages."""
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


def read_poses(path: Path, latitude_deg: float, longitude_deg: float) -> GivenPoses:
    """The poses of a file, for a site at these coordinates. Raises UserError with the first line that is wrong."""
    return _checked(_Source(path, *read_table(path)), latitude_deg, longitude_deg)


@dataclass(frozen=True, slots=True)
class _Source:
    """A file as read."""

    path: Path
    table: pd.DataFrame
    stated: dict[str, str]
    """What its header states: frame, rotation, origin_m."""
    line: np.ndarray | None
    """Line of each pose (N,); None if rows are counted from 0."""

    def numbers(self, names: tuple[str, ...]) -> Array:
        """Columns as an array (N, k). Raises UserError for a value that is not a finite number."""
        columns = []
        for name in names:
            values = pd.to_numeric(self.table[name], errors="coerce").to_numpy(np.float64)
            self.refuse(
                ~np.isfinite(values),
                name,
                lambda row, name=name: str(self.table[name].iloc[row]) or "empty",
                "a number",
            )
            columns.append(values)
        return np.stack(columns, axis=1)

    def refuse(self, wrong: np.ndarray, field: str, found, expected: str) -> None:
        """Raise UserError for the first true value of `wrong` (N,); `found` makes a text from its index."""
        if wrong.any():
            row = int(np.argmax(wrong))
            place = f"row {row}" if self.line is None else f"line {self.line[row]}"
            raise UserError(self.path, f"{place}: {field}", found(row), expected)


def _checked(source: _Source, latitude_deg: float, longitude_deg: float) -> GivenPoses:
    path, table, stated = source.path, source.table, source.stated
    frame = stated.get("frame")
    if frame not in FRAMES:
        line = "the comment line `# frame: O_L`" if path.suffix != ".parquet" else "the metadata key frame"
        found = "not stated" if frame is None else frame
        raise UserError(path, "frame", found, f"{line}, with one of {', '.join(FRAMES)}")
    _check_site(path, stated.get("site"), latitude_deg, longitude_deg)
    names = (*_TIME, *FRAMES[frame], *_ROTATION)
    _check_columns(path, list(table.columns), names)
    if not 1 <= len(table) <= _MAX_POSES:
        raise UserError(path, "poses", len(table), f"1 to {_MAX_POSES}")
    place = source.numbers(FRAMES[frame])
    if frame == "selenographic":
        x, y = site_from_selenographic(place[:, 0], place[:, 1], latitude_deg, longitude_deg)
        place = np.stack([x, y, place[:, 2]], axis=1)
    if frame == "O_W":
        place = place + _origin(path, stated)
    source.refuse(
        (np.abs(place) > _LARGEST_M).any(axis=1),
        "position",
        lambda row: f"{np.abs(place[row]).max():.3g} m from the site",
        f"at most {_LARGEST_M:.0f} m",
    )
    trajectory = _trajectories(source)
    time = source.numbers(_TIME)[:, 0]
    late = np.concatenate([[False], (np.diff(time) <= 0) & (np.diff(trajectory) == 0)])
    source.refuse(late, "time_s", lambda row: f"{time[row]:g} after {time[row - 1]:g}", "increasing times")
    velocity = _motion(source, "velocity", _VELOCITY, LARGEST_MPS, "m/s")
    turn = _motion(source, "angular velocity", _TURN, LARGEST_RADPS, "rad/s")
    sun = source.numbers(_SUN) if _SUN[0] in table else None
    if sun is not None:
        low = (sun[:, 1] <= 0) | (sun[:, 1] > 90)
        source.refuse(low, _SUN[1], lambda row: f"{sun[row, 1]:g}", "above 0 (the horizon), at most 90 degrees")
    velocity = np.zeros((len(table), 3)) if velocity is None else velocity
    return GivenPoses(time, place, _unit_quaternions(source), velocity, sun, trajectory, turn, source.line)


def _motion(source: _Source, field: str, names: tuple[str, ...], largest: float, unit: str) -> Array | None:
    """Vectors (N, 3) of at most this length; None if the file has none."""
    if names[0] not in source.table:
        return None
    values = source.numbers(names)
    with np.errstate(over="ignore"):
        length = np.linalg.norm(values, axis=1)
    source.refuse(length > largest, field, lambda row: f"{length[row]:.4g} {unit}", f"at most {largest:g} {unit}")
    return values


def _check_columns(path: Path, found: list[str], names: tuple[str, ...]) -> None:
    """Raises UserError for a column that is missing, unknown, given twice, or without the others of its group."""
    known = (*names, *_VELOCITY, *_TURN, *_SUN, _TRAJECTORY)
    for name in found:
        if name not in known:
            raise UserError(path, "column", name, nearest(name, known))
        if found.count(name) > 1:
            raise UserError(path, "column", f"{name} twice", "each column once")
    for group in (names, _VELOCITY, _TURN, _SUN):
        missing = [name for name in group if name not in found]
        if missing and (group is names or len(missing) < len(group)):
            raise UserError(path, "column", f"no {missing[0]}", f"the columns {', '.join(group)}")


def _check_site(path: Path, stated: str | None, latitude_deg: float, longitude_deg: float) -> None:
    """Raises UserError if a file states another site than that of the scene."""
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


def _unit_quaternions(source: _Source) -> Array:
    """Quaternions rotation_camera_from_site (N, 4) of length 1 with w >= 0."""
    direction = source.stated.get("rotation", _DIRECTIONS[0])
    if direction not in _DIRECTIONS:
        raise UserError(source.path, "rotation", direction, " or ".join(_DIRECTIONS))
    q = source.numbers(_ROTATION)
    length = np.linalg.norm(q, axis=1)
    source.refuse(
        np.abs(length - 1) > _LENGTH_TOLERANCE,
        "quaternion",
        lambda row: f"length {length[row]:.4g}",
        "a unit quaternion qw, qx, qy, qz",
    )
    q = q / length[:, None]
    if direction == _DIRECTIONS[1]:
        q = q * [1, -1, -1, -1]
    return np.where(q[:, :1] < 0, -q, q) + 0.0


def _trajectories(source: _Source) -> np.ndarray:
    """Number of each pose's trajectory, by the column `trajectory`, whose equal values must follow each other."""
    if _TRAJECTORY not in source.table:
        return np.zeros(len(source.table), int)
    names = source.table[_TRAJECTORY].astype(str).to_numpy()
    begins = np.concatenate([[True], names[1:] != names[:-1]])
    again = np.zeros(len(names), bool)
    again[begins] = pd.Series(names[begins]).duplicated().to_numpy()
    source.refuse(again, _TRAJECTORY, lambda row: f"{names[row]} again", "the poses of a trajectory one after another")
    return np.cumsum(begins) - 1
