"""Read the table of a pose file (CSV, Parquet, TUM, EuRoC or KITTI) and the statements in its header.

All formats are converted to the columns of the CSV format. The reader of tables has limits on rows and bytes.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perilune_shared.config.errors import nearest
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import POSES
from perilune_shared.storage.tables.read import open_table

SITE_FROM_CAMERA = "site_from_camera"
"""Direction of rotation in a header, and in every TUM, EuRoC and KITTI file."""
_KEYS = ("frame", "rotation", "origin_m", "site", "camera_axes")
TIME, POSITION, ROTATION = "time_s", ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
SELENOGRAPHIC = ("latitude_deg", "longitude_deg", "height_m")
VELOCITY, SUN = ("vx_mps", "vy_mps", "vz_mps"), ("sun_azimuth_deg", "sun_elevation_deg")
TURN = ("wx_radps", "wy_radps", "wz_radps")
TRAJECTORY = "trajectory"
_TUM = (TIME, *POSITION, "qx", "qy", "qz", "qw")
_TUM_HEADER = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_KITTI = tuple(f"matrix_{row}{column}" for row in "123" for column in "1234")
_EUROC: dict[str, str] = {
    **{f"p_RS_R_{axis}": name for axis, name in zip("xyz", POSITION, strict=True)},
    **{f"q_RS_{axis}": name for axis, name in zip("wxyz", ROTATION, strict=True)},
    **{f"v_RS_R_{axis}": name for axis, name in zip("xyz", VELOCITY, strict=True)},
}
_EUROC_BIASES = tuple(f"b_{kind}_RS_S_{axis}" for kind in "wa" for axis in "xyz")
_SUFFIXES = (".csv", ".parquet", ".tum", ".txt", ".kitti")
_OTHER_SUFFIXES = {".json": "JSON, as of NeRF or Blender", ".bag": "a ROS bag", ".db3": "a ROS bag", ".mcap": "MCAP"}
_LARGEST_S = 1e11
"""Largest time that can be in seconds; nanoseconds since 1970 are 1e18."""
_MATRIX_TOLERANCE = 0.01
"""Largest deviation of a rotation matrix that rounded digits can explain."""
_IDENTITY_TOLERANCE = 1e-6
_EULER = re.compile(r"(roll|pitch|yaw|euler|heading|omega|phi|kappa|rot_?[xyz]$|r[xyz]$)", re.IGNORECASE)
_MATRIX = re.compile(r"(r|m|rot)_?[0-3][0-3]$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The table of a file, with the columns of the CSV format."""

    columns: Columns
    """Time, position, rotation, and the other columns of the file."""
    stated: dict[str, str]
    """Statements in the header: frame, rotation, origin_m, site, camera_axes."""
    format: str
    """Name of the format: CSV, Parquet, TUM, EuRoC or KITTI."""
    time_ns: np.ndarray | None = None
    """Times in the file (N,), if they are in nanoseconds; the column `time_s` then starts from 0."""

    def time_text(self, row: int) -> str:
        """The time of a row as in the file."""
        if self.time_ns is not None:
            return f"{self.time_ns[row]} ns"
        return np.format_float_positional(self.columns.numbers(TIME)[row], trim="-")


def read_pose_table(path: Path) -> PoseTable:
    """Read the table of a file.

    Raises UserError if the file is unreadable, has another format, or has an unknown column.
    """
    suffix = path.suffix.lower()
    if path.exists() and suffix not in _SUFFIXES:
        found = _OTHER_SUFFIXES.get(suffix, suffix or "none")
        raise UserError(path, "format", found, "poses as .csv, .parquet, .tum, or .txt of TUM or KITTI")
    with open_table(path, POSES, header=()) as table:
        comments, metadata, first = table.comments, table.metadata, table.peek()
    if any("IMAGE_ID" in comment for comment in comments):
        raise UserError(path, "format", "COLMAP's images.txt", "CSV with the columns time_s, x_m to z_m, qw to qz")
    stated = _stated([*metadata.items(), *(comment.partition(":")[::2] for comment in comments)])
    header = _euroc_header(comments, len(first[1])) if first is not None else None
    if first is not None and header is None and suffix != ".csv" and _are_numbers(first[1]):
        return _without_header(path, stated, *first)
    with open_table(path, POSES, header) as table:
        if not table.names:
            expected = "a line with the names of the columns, then one line for each pose"
            raise UserError(path, "table", "no line", expected)
        if any("p_RS_R_x" in name for name in table.names):
            return _euroc(path, table.names, header, stated)
        if tuple(table.names) == _TUM_HEADER:
            renamed = dict(zip(_TUM_HEADER, _TUM, strict=True))
            return PoseTable(
                _seconds(_renamed(table.read(dict.fromkeys(_TUM_HEADER, "number")), renamed)),
                _fixed_direction(path, stated, "TUM"),
                "TUM",
            )
        frame = stated.get("frame", "")
        position = SELENOGRAPHIC if frame == "selenographic" else POSITION
        _check_columns(path, table.names, position)
        kinds: dict[str, Kind] = dict.fromkeys((TIME, *position, *ROTATION, *VELOCITY, *TURN, *SUN), "number")
        columns = table.read({**kinds, TRAJECTORY: "text"})
    return PoseTable(_seconds(columns), stated, "CSV" if columns.lines is not None else "Parquet")


def _stated(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """The known statements among pairs of key and value; other keys are ignored."""
    return {key.strip(): value.strip() for key, value in pairs if key.strip() in _KEYS and value}


def _are_numbers(words: Sequence[str]) -> bool:
    try:
        [float(word) for word in words if word]
    except ValueError:
        return False
    return True


def _euroc_header(comments: Sequence[str], n_columns: int) -> list[str] | None:
    """The names of the columns in a comment of an EuRoC file."""
    for comment in comments:
        names = [name.strip() for name in comment.split(",")]
        if "p_RS_R_x" in comment and len(names) == n_columns:
            return names
    return None


def _check_columns(path: Path, found: Sequence[str], position: tuple[str, ...]) -> None:
    """Raise UserError for a column that is missing, unknown, repeated, or without the rest of its group."""
    needed = (TIME, *position, *ROTATION)
    known = (*needed, *VELOCITY, *TURN, *SUN, TRAJECTORY)
    if ROTATION[0] not in found:
        for name in found:
            if name not in known and (_EULER.match(name) or _MATRIX.match(name)):
                kind = "Euler angles" if _EULER.match(name) else "a rotation matrix"
                expected = "quaternions in the columns qw, qx, qy, qz; scipy.spatial.transform.Rotation converts"
                raise UserError(path, "rotation", f"{kind} (column {name})", expected)
    for name in found:
        if name not in known:
            raise UserError(path, "column", name or "a column without a name", nearest(name, known))
        if list(found).count(name) > 1:
            raise UserError(path, "column", f"{name} twice", "each column once")
    for group in (needed, VELOCITY, TURN, SUN):
        missing = [name for name in group if name not in found]
        if missing and (group is needed or len(missing) < len(group)):
            raise UserError(path, "column", f"no {missing[0]}", f"the columns {', '.join(group)}")


def _seconds(columns: Columns) -> Columns:
    """Return the columns. Raises UserError for times that cannot be seconds."""
    expected = "seconds; these may be nanoseconds: divide by 1e9"
    columns.check(TIME, ~(np.abs(columns.numbers(TIME)) > _LARGEST_S), expected)
    return columns


def _renamed(columns: Columns, names: Mapping[str, str]) -> Columns:
    arrays = {names[name]: array for name, array in columns.arrays.items()}
    return Columns(columns.path, arrays, columns.n_rows, columns.lines)


def _fixed_direction(path: Path, stated: dict[str, str], name: str) -> dict[str, str]:
    """The header's statements, with the format's direction of rotation.

    Raises UserError if the header contradicts the format.
    """
    if stated.get("rotation", SITE_FROM_CAMERA) != SITE_FROM_CAMERA:
        raise UserError(path, "rotation", stated["rotation"], f"{SITE_FROM_CAMERA}, as in every {name} file")
    if stated.get("frame") == "selenographic":
        raise UserError(path, "frame", "selenographic", f"O_L or O_W in a {name} file")
    return stated | {"rotation": SITE_FROM_CAMERA}


def _without_header(path: Path, stated: dict[str, str], line: int, words: Sequence[str]) -> PoseTable:
    """The table of a TUM or KITTI file, recognised by the number of values in its first line."""
    n_columns = len(words)
    if n_columns not in (len(_TUM), len(_KITTI)):
        expected = "timestamp tx ty tz qx qy qz qw (TUM), or 12 values of a 3 x 4 matrix (KITTI)"
        raise UserError(f"{path}:{line}", "values", n_columns, expected)
    name, header = ("TUM", _TUM) if n_columns == len(_TUM) else ("KITTI", _KITTI)
    with open_table(path, POSES, header) as table:
        columns = table.read(dict.fromkeys(header, "number"))
    stated = _fixed_direction(path, stated, name)
    return PoseTable(_seconds(columns if name == "TUM" else _kitti(path, columns)), stated, name)


def _euroc(path: Path, names: Sequence[str], header: Sequence[str] | None, stated: dict[str, str]) -> PoseTable:
    """The table of an EuRoC or TUM-VI file.

    Times are in nanoseconds, and the names of columns have units, such as `q_RS_w []`.
    """
    plain = {name: re.sub(r"\s*\[.*$", "", name) for name in names}
    known = {"timestamp": TIME, **_EUROC}
    for name in plain.values():
        if name not in known and name not in _EUROC_BIASES:
            raise UserError(path, "column of an EuRoC file", name, nearest(name, known))
    missing = [name for name in list(known)[:8] if name not in plain.values()]
    if missing:
        raise UserError(
            path, "column of an EuRoC file", f"no {missing[0]}", f"the columns {', '.join(list(known)[:8])}"
        )
    kinds: dict[str, Kind] = {
        name: "integer" if short == "timestamp" else "number" for name, short in plain.items() if short in known
    }
    with open_table(path, POSES, header) as table:
        columns = table.read(kinds)
    columns = _renamed(columns, {name: known[short] for name, short in plain.items() if short in known})
    time_ns = columns.integers(TIME)
    columns.arrays[TIME] = (time_ns - time_ns[:1].sum()) / 1e9
    return PoseTable(columns, _fixed_direction(path, stated, "EuRoC"), "EuRoC", time_ns)


def _kitti(path: Path, columns: Columns) -> Columns:
    """Columns of a KITTI file: matrices (3, 4) from the camera to the site, and times from a second file."""
    poses = np.stack([columns.finite(name) for name in _KITTI], axis=1).reshape(-1, 3, 4)
    rotation: Array = poses[:, :, :3]
    off = np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    columns.check(_KITTI[0], (off <= _MATRIX_TOLERANCE) & (np.linalg.det(rotation) > 0), "the matrix of a rotation")
    if len(poses) and np.abs(poses[0] - np.eye(4)[:3]).max() < _IDENTITY_TOLERANCE:
        found = "the identity at the first pose, so poses relative to the first camera"
        raise UserError(path, "poses of a KITTI file", found, "poses from the camera to the site, O_L or O_W")
    quaternions = np.stack([quaternion_from_matrix(each) for each in rotation]) if len(poses) else np.zeros((0, 4))
    values = [_kitti_times(path, len(poses)), *poses[:, :, 3].T, *quaternions.T]
    arrays = dict(zip((TIME, *POSITION, *ROTATION), values, strict=True))
    return Columns(path, arrays, columns.n_rows, columns.lines)


def _kitti_times(path: Path, n_poses: int) -> Array:
    """Times of a KITTI file, read from NAME.times.txt or times.txt beside it."""
    beside = [path.with_name(f"{path.stem}.times.txt"), path.with_name("times.txt")]
    times_file = next((each for each in beside if each.is_file()), None)
    if times_file is None:
        expected = f"{beside[0].name} or times.txt beside it, a time in seconds for each pose"
        raise UserError(path, "times of a KITTI file", "no such file", expected)
    with open_table(times_file, POSES, (TIME,)) as table:
        times = table.read({TIME: "number"}).finite(TIME)
    if len(times) != n_poses:
        raise UserError(times_file, "times", len(times), f"{n_poses}, one for each pose of {path.name}")
    return times
