"""Read frames and measurements of a descent, or files of EuRoC and TUM-VI, all untrusted input."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import ATTITUDES, BEAMS, FRAMES, INERTIAL, RANGES, TableLimits
from perilune_shared.storage.tables.read import open_table, read_table
from perilune_train.detect.images.read import picture_size
from perilune_train.landing.filter.flight import DopplerLidar, Instruments, StarTracker
from perilune_train.landing.filter.lander import Beam, LidarErrors
from perilune_train.landing.filter.propagate import Increments

FRAMES_FILE = "frames.csv"
FRAME_COLUMNS = ("file", "time_s")
RATES = tuple(f"angular_rate_{axis}_radps" for axis in "xyz")
FORCES = tuple(f"specific_force_{axis}_mps2" for axis in "xyz")
INERTIAL_COLUMNS = ("time_s", "interval_s", *RATES, *FORCES)
RANGE_COLUMNS = ("time_s", "range_m")
STAR_TRACKER_COLUMNS = ("time_s", *(f"rotation_{axis}" for axis in "wxyz"))
BEAM_DIRECTION = tuple(f"beam_{axis}_body" for axis in "xyz")
DOPPLER_LIDAR_COLUMNS = ("time_s", *BEAM_DIRECTION, "speed_mps", "range_m")
CRATER_COLUMNS = ("x_m", "y_m", "z_m", "diameter_m")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
_EUROC_FRAMES_FILE, _EUROC_FOLDER = "data.csv", "data"
_TIME_NS, _FILE = "timestamp", "filename"
_EUROC_SAMPLES = (
    tuple(f"{kind}_RS_S_{axis}" for kind in "wa" for axis in "xyz"),
    tuple(f"{kind}_{axis}" for kind in ("omega", "alpha") for axis in "xyz"),
)
"""Column names of rates and specific forces in files of EuRoC and TUM-VI, and in files of Kalibr."""
_UNIT_TOLERANCE = 1e-3
"""Largest accepted difference of a quaternion's or direction's length from 1."""
_MIN_STEP_S = 1e-3
"""Shortest time between two measurements of one beam that the filter assumes, seconds."""
_GAP = 5
"""An interval between samples is a gap if it is longer than this multiple of the median interval."""
_LARGEST_S = 1e11
"""Largest valid time in seconds. Times in milliseconds since 1970 are about 1e12 and exceed it."""


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Frames in time order."""

    paths: list[Path]
    """Image files (n)."""
    time_s: Array
    """Seconds since the start of the descent (n,)."""


def read_frame_files(folder: Path, camera: Camera) -> FrameFiles:
    """Read the frames of a folder: frames.csv, or data.csv of EuRoC with images in the folder data.

    frames.csv has the columns file and time_s. Raises UserError if times do not increase, a file is missing or outside
    the folder, or an image differs in size from the camera.
    """
    path = folder / FRAMES_FILE
    if not path.exists() and (folder / _EUROC_FRAMES_FILE).is_file():
        path, folder = folder / _EUROC_FRAMES_FILE, folder / _EUROC_FOLDER
        table = read_euroc(path, FRAMES, {_TIME_NS: "integer", _FILE: "text"})
        column, time_s = _FILE, nanoseconds_as_seconds(table)
    else:
        table = read_table(path, FRAMES, {"file": "text", "time_s": "number"})
        column, time_s = "file", increasing(table)
    if not table.n_rows:
        raise UserError(path, "rows", 0, "one row for each frame")
    paths = []
    for row, name in enumerate(table.texts(column).to_list()):
        if not name or Path(name).is_absolute() or ".." in Path(name).parts:
            raise table.fault(row, column, "a file of this folder")
        paths.append(folder / name)
        width, height = picture_size(paths[-1])
        if (width, height) != (camera.width_px, camera.height_px):
            expected = f"{camera.width_px} x {camera.height_px}, the camera's size"
            raise UserError(paths[-1], "size", f"{width} x {height}", expected)
    return FrameFiles(paths, time_s)


@dataclass(frozen=True, slots=True)
class InstrumentFiles:
    """Files of the measurements of a descent."""

    imu: Path | None
    """Inertial measurements, imu.csv or samples in EuRoC's format; None without an inertial unit."""
    ranges: Path | None = None
    """Ranges of a laser altimeter, ranges.csv."""
    star_tracker: Path | None = None
    """Attitudes of a star tracker, star_tracker.csv."""
    doppler_lidar: Path | None = None
    """Ranges and speeds along the beams of a Doppler lidar, doppler_lidar.csv."""


def read_instruments(files: InstrumentFiles, star_sigmas_rad: Array, lidar: LidarErrors) -> Instruments:
    """Read the measurements of a descent. Empty values and NaN are missing measurements.

    `star_sigmas_rad` (3,) are the standard deviations of the star tracker about the body's axes; `lidar` has the
    standard deviations of the Doppler lidar. Raises UserError on a missing column, a value that is not a number, or
    times that do not increase.
    """
    inertial = _NO_INERTIAL if files.imu is None else _read_inertial(files.imu)
    range_time_s, range_m = np.zeros(0), np.zeros(0)
    if files.ranges is not None:
        lengths = read_table(files.ranges, RANGES, dict.fromkeys(RANGE_COLUMNS, "number"))
        range_time_s, range_m = increasing(lengths), lengths.numbers("range_m")
    stars = None if files.star_tracker is None else _read_star_tracker(files.star_tracker, star_sigmas_rad)
    beams = None if files.doppler_lidar is None else _read_doppler_lidar(files.doppler_lidar, lidar)
    return Instruments(inertial, range_time_s, range_m, stars, beams)


_NO_INERTIAL = Increments(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))


def _read_star_tracker(path: Path, sigmas_rad: Array) -> StarTracker:
    table = read_table(path, ATTITUDES, dict.fromkeys(STAR_TRACKER_COLUMNS, "number"))
    time_s = increasing(table)
    quaternions = np.column_stack([table.numbers(name) for name in STAR_TRACKER_COLUMNS[1:]])
    length = np.linalg.norm(quaternions, axis=1)
    is_missing = np.isnan(quaternions).any(axis=1)
    table.check("rotation_w", is_missing | (np.abs(length - 1) <= _UNIT_TOLERANCE), "a unit quaternion, or nothing")
    rotations = np.full((len(time_s), 3, 3), np.nan)
    rotations[~is_missing] = matrix_from_quaternion(quaternions[~is_missing] / length[~is_missing, None])
    return StarTracker(time_s, rotations, sigmas_rad)


def _read_doppler_lidar(path: Path, errors: LidarErrors) -> DopplerLidar:
    table = read_table(path, BEAMS, dict.fromkeys(DOPPLER_LIDAR_COLUMNS, "number"))
    time_s = increasing(table, strictly=False)
    directions = np.column_stack([table.finite(name, -1, 1) for name in BEAM_DIRECTION])
    table.check(
        BEAM_DIRECTION[2],
        np.abs(np.linalg.norm(directions, axis=1) - 1) <= _UNIT_TOLERANCE,
        "a unit vector beam_x_body, beam_y_body, beam_z_body",
    )
    table.check(BEAM_DIRECTION[2], directions[:, 2] < 0, "below 0: the beam points down, along -Z_B")
    speeds, ranges = table.numbers("speed_mps"), table.numbers("range_m")
    beams = [Beam(*row) for row in zip(directions, speeds.tolist(), ranges.tolist(), strict=True)]
    _, first, counts = np.unique(directions.round(6), axis=0, return_index=True, return_counts=True)
    of_beam = (directions.round(6) == directions[first[counts.argmax()]].round(6)).all(axis=1) if len(beams) else []
    step_s = float(np.median(np.diff(time_s[of_beam]))) if np.sum(of_beam) > 1 else errors.step_s
    return DopplerLidar(time_s, beams, replace(errors, step_s=max(step_s, _MIN_STEP_S)))


def read_euroc(path: Path, limits: TableLimits, columns: dict[str, Kind]) -> Columns:
    """Read columns of a file of EuRoC or TUM-VI; the keys of `columns` are names without units.

    The header may be a comment. Raises UserError if a column is missing.
    """
    names, is_comment = _header(path, limits)
    plain = {name: plain_name(name) for name in names}
    missing = [name for name in columns if name not in plain.values()]
    if missing:
        raise UserError(path, "columns", f"no {missing[0]}", ", ".join(columns))
    with open_table(path, limits, names if is_comment else None) as table:
        read = table.read({name: columns[short] for name, short in plain.items() if short in columns})
    arrays = {plain[name]: array for name, array in read.arrays.items()}
    return Columns(path, arrays, read.n_rows, read.lines)


def plain_name(name: str) -> str:
    """The name of a column without its unit: `timestamp` for `timestamp [ns]`."""
    return re.sub(r"\s*\[.*$", "", name.lstrip("# "))


def column_names(path: Path, limits: TableLimits) -> list[str]:
    """Names of the columns without their units; the header may be a comment."""
    return [plain_name(name) for name in _header(path, limits)[0]]


def _header(path: Path, limits: TableLimits) -> tuple[list[str], bool]:
    """Names of the columns, and whether they come from a comment that starts with the time column."""
    with open_table(path, limits, header=()) as table:
        first = table.peek()
        for comment in reversed(table.comments):
            names = [name.strip() for name in comment.split(",")]
            if plain_name(names[0]) == _TIME_NS and (first is None or len(names) == len(first[1])):
                return names, True
        return list(table.names) if first is None else first[1], False


def _read_inertial(path: Path) -> Increments:
    known = column_names(path, INERTIAL)
    samples = next((names for names in _EUROC_SAMPLES if names[0] in known), None)
    if samples is not None and _TIME_NS in known:
        return _of_samples(path, samples)
    table = read_table(path, INERTIAL, dict.fromkeys(INERTIAL_COLUMNS, "number"))
    if not table.n_rows:
        raise UserError(path, "rows", 0, "one row for each measurement")
    end_s, interval_s = increasing(table), table.finite("interval_s")
    table.check("interval_s", (interval_s > 0) & (interval_s <= 1), "above 0, at most 1 s")
    _check_steps(table, end_s, interval_s)
    rates, forces = (np.column_stack([table.numbers(name) for name in names]) for names in (RATES, FORCES))
    return Increments(end_s, interval_s, rates, forces)


def _of_samples(path: Path, names: tuple[str, ...]) -> Increments:
    """Convert samples, with times in nanoseconds, to means over the intervals between them, without gaps."""
    table = read_euroc(path, INERTIAL, {_TIME_NS: "integer", **dict.fromkeys(names, "number")})
    if table.n_rows < 2:
        raise UserError(path, "rows", table.n_rows, "at least two measurements")
    time_s = nanoseconds_as_seconds(table)
    interval_s = np.diff(table.integers(_TIME_NS)) / 1e9
    values = np.column_stack([table.numbers(name) for name in names])
    means = (values[1:] + values[:-1]) / 2
    kept = (interval_s <= 1) & (interval_s <= _GAP * np.median(interval_s))
    if not kept.any():
        expected = "samples at most 1 s apart, in nanoseconds"
        raise UserError(path, _TIME_NS, f"steps of {np.median(interval_s):g} s", expected)
    return Increments(time_s[1:][kept], interval_s[kept], means[kept, :3], means[kept, 3:])


def nanoseconds_as_seconds(table: Columns) -> Array:
    """Times in nanoseconds as seconds. Raises UserError if they do not increase."""
    time_ns = table.integers(_TIME_NS)
    late = np.diff(time_ns) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        raise table.fault(row, _TIME_NS, f"above {time_ns[row - 1]}, the time of the row before")
    return time_ns / 1e9


def increasing(table: Columns, strictly: bool = True) -> Array:
    """Times in seconds. Raises UserError if they decrease or cannot be seconds.

    If `strictly`, also raises UserError if they repeat.
    """
    time_s = table.finite("time_s")
    table.check("time_s", np.abs(time_s) <= _LARGEST_S, "seconds; these may be nanoseconds: divide by 1e9")
    step_s = np.diff(time_s)
    late = step_s <= 0 if strictly else step_s < 0
    if late.any():
        row = int(late.argmax()) + 1
        limit = "above" if strictly else "at least"
        raise table.fault(row, "time_s", f"{limit} {time_s[row - 1]}, the time of the row before")
    return time_s


def _check_steps(table: Columns, end_s: Array, interval_s: Array) -> None:
    """Raise UserError if the times of measurements and the lengths of their intervals differ in unit."""
    if len(end_s) < 2:
        return
    step, interval = float(np.median(np.diff(end_s))), float(np.median(interval_s))
    unit = unit_of(step / interval)
    if unit is not None:
        found = f"steps of {step:g} between measurements of {interval:g} s"
        raise UserError(table.path, "time_s", found, f"seconds; these may be {unit[0]}: divide by {unit[1]:g}")


def unit_of(ratio: float) -> tuple[str, float] | None:
    """The unit of time that has about `ratio` units per second, with the exact number; None if none fits."""
    for name, per_s in (("nanoseconds", 1e9), ("microseconds", 1e6), ("milliseconds", 1e3)):
        if per_s / 5 < ratio < 5 * per_s:
            return name, per_s
    return None
