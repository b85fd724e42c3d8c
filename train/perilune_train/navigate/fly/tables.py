"""Tables of a descent: frames.csv, imu.csv and ranges.csv. All are untrusted input."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.detect.images.read import picture_size
from perilune_train.navigate.filter.flight import Instruments
from perilune_train.navigate.filter.propagate import Increments

FRAMES_FILE = "frames.csv"
FRAME_COLUMNS = ("file", "time_s")
RATES = tuple(f"angular_rate_{axis}_radps" for axis in "xyz")
FORCES = tuple(f"specific_force_{axis}_mps2" for axis in "xyz")
INERTIAL_COLUMNS = ("time_s", "interval_s", *RATES, *FORCES)
RANGE_COLUMNS = ("time_s", "range_m")
CRATER_COLUMNS = ("x_m", "y_m", "z_m", "diameter_m")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
_LARGEST_FILE_BYTES = 4 * 2**30


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """Frames in the order of time."""

    paths: list[Path]
    """Image files (n)."""
    time_s: Array
    """Seconds since the start of the descent (n,)."""


def read_numbers(path: Path, columns: tuple[str, ...]) -> Array:
    """Read columns of a CSV file as finite numbers (rows, columns). Raises UserError if one is missing or no number."""
    table = _read_csv(path, columns)
    return np.column_stack([_numbers(path, table, name) for name in columns])


def read_frame_files(folder: Path, camera: Camera) -> FrameFiles:
    """Read frames.csv of a folder: file, time_s.

    Raises UserError if times do not increase, a file is missing or outside the folder, or an image is not of the
    camera's size.
    """
    path = folder / FRAMES_FILE
    table = _read_csv(path, FRAME_COLUMNS, text=("file",))
    time_s = _increasing(path, _numbers(path, table, "time_s"))
    if not len(time_s):
        raise UserError(path, "rows", 0, "one row for each frame")
    paths = []
    for row, name in enumerate(table["file"].to_pylist()):
        if not name or Path(name).is_absolute() or ".." in Path(name).parts:
            raise UserError(path, f"file: row {row}", repr(name), "a file of this folder")
        paths.append(folder / name)
        width, height = picture_size(paths[-1])
        if (width, height) != (camera.width_px, camera.height_px):
            expected = f"{camera.width_px} x {camera.height_px}, the camera's size"
            raise UserError(paths[-1], "size", f"{width} x {height}", expected)
    return FrameFiles(paths, time_s)


def read_instruments(imu: Path, ranges: Path | None) -> Instruments:
    """Read imu.csv and ranges.csv. Values that are empty or NaN are measurements that are missing.

    Raises UserError on a missing column, a value that is no number, or times that do not increase.
    """
    table = _read_csv(imu, INERTIAL_COLUMNS)
    end_s, interval_s = _increasing(imu, _numbers(imu, table, "time_s")), _numbers(imu, table, "interval_s")
    if not len(end_s):
        raise UserError(imu, "rows", 0, "one row for each measurement")
    wrong = ~((interval_s > 0) & (interval_s <= 1))
    if wrong.any():
        row = int(wrong.argmax())
        raise UserError(imu, f"interval_s: row {row}", interval_s[row], "above 0, at most 1 s")
    rates, forces = (np.column_stack([_values(table, name) for name in names]) for names in (RATES, FORCES))
    inertial = Increments(end_s, interval_s, rates, forces)
    if ranges is None:
        return Instruments(inertial, np.zeros(0), np.zeros(0))
    lengths = _read_csv(ranges, RANGE_COLUMNS)
    return Instruments(inertial, _increasing(ranges, _numbers(ranges, lengths, "time_s")), _values(lengths, "range_m"))


def _read_csv(path: Path, columns: tuple[str, ...], text: tuple[str, ...] = ()) -> pa.Table:
    _check_file(path, "a CSV file")
    types = {name: pa.string() if name in text else pa.float64() for name in (*columns, *NORMAL_COLUMNS)}
    try:
        convert = pyarrow.csv.ConvertOptions(column_types=types, null_values=["", "nan", "NaN"])
        table = pyarrow.csv.read_csv(path, convert_options=convert)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise UserError(path, "table", error, f"CSV with a header and the columns {', '.join(columns)}") from None
    return _with_columns(path, table, columns)


def _check_file(path: Path, expected: str) -> None:
    if not path.is_file():
        raise UserError(path, "table", "a folder" if path.is_dir() else "no such file", expected)
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        raise UserError(path, "table", f"{path.stat().st_size} bytes", f"at most {_LARGEST_FILE_BYTES}")


def _with_columns(path: Path, table: pa.Table, columns: tuple[str, ...]) -> pa.Table:
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise UserError(path, "columns", f"no {', '.join(missing)}", ", ".join(columns))
    for name in (*columns, *NORMAL_COLUMNS):
        if (number := table.column_names.count(name)) > 1:
            raise UserError(path, "columns", f"{number} times {name}", f"{name} once")
    return table


def _values(table: pa.Table, name: str) -> Array:
    """A column as float64 (n,), NaN where it has no value."""
    return np.asarray(table[name].cast(pa.float64()).to_numpy(zero_copy_only=False), np.float64)


def _numbers(path: Path, table: pa.Table, name: str) -> Array:
    """A column as finite float64 (n,)."""
    values = _values(table, name)
    wrong = ~np.isfinite(values)
    if wrong.any():
        row = int(wrong.argmax())
        raise UserError(path, f"{name}: row {row}", values[row], "a finite number")
    return values


def _increasing(path: Path, time_s: Array) -> Array:
    late = np.diff(time_s) <= 0
    if late.any():
        row = int(late.argmax()) + 1
        raise UserError(path, f"time_s: row {row}", time_s[row], f"above {time_s[row - 1]}, the time of the row before")
    return time_s
