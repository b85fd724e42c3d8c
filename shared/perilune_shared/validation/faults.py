"""The class Fault, and checks of a single part: name, schema and values."""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import FRAME_ID_PATTERN, ID_PATTERN, PART_PATTERN, SPLITS, is_whole
from perilune_shared.dataset.schema import MAY_BE_ABSENT, TABLES
from perilune_shared.dataset.statistics import false_statistics
from perilune_shared.errors import UserError, one_line, shortened

_PATH = r"^[A-Za-z0-9][A-Za-z0-9._/-]{0,199}$"
_PLAIN = r"^[A-Za-z0-9][A-Za-z0-9 ._+,:()/-]{0,199}$"
_COLUMN = r"^[A-Za-z][A-Za-z0-9_]{0,63}$"
_SHA256 = r"^[0-9a-f]{64}$"
_PATTERNS = {
    "scene_id": ID_PATTERN,
    "trajectory_id": ID_PATTERN,
    "frame_id": FRAME_ID_PATTERN,
    "png_path": _PATH,
    "exr_path": _PATH,
    "lidar_path": _PATH,
    "hazard_path": _PATH,
    "png_sha256": _SHA256,
    "exr_sha256": _SHA256,
    "lidar_sha256": _SHA256,
    "hazard_sha256": _SHA256,
    "content_sha256": _SHA256,
    "recipe": r"^[0-9a-f]{16}$",
    "split": "^(" + "|".join(SPLITS) + ")$",
}
_POSITIVE = (
    "diameter_m",
    "catalogue_diameter_m",
    "extent_m",
    "ellipse_a_px",
    "ellipse_b_px",
    "radius_px",
    "duration_s",
    "n_frames",
    "width_px",
    "height_px",
    "fx_px",
    "fy_px",
    "png_bytes",
    "exr_bytes",
    "lidar_bytes",
    "hazard_bytes",
    "interval_s",
    "range_m",
)
_NOT_NEGATIVE = (
    "crater_id",
    "boulder_id",
    "beam",
    "shape_id",
    "frame_index",
    "seed",
    "time_s",
    "n_craters_above_max_radius",
)
_RANGES = {
    "latitude_deg": (-90, 90),
    "longitude_deg": (-180, 180),
    "sun_azimuth_deg": (-360, 360),
    "sun_elevation_deg": (-90, 90),
    "visible_fraction": (0, 1),
    "sunlit_fraction": (0, 1),
    "real_ground_share": (0, 1),
    "age_myr": (0, 4600),
    "rim_rms_share": (0, 1),
    "rim_axis_ratio": (0, 1),
    "ellipse_theta_rad": (0, np.pi),
}
_UNIT_VECTORS = ("rotation_wxyz", "sun_direction", "beam_in_body")
MAX_PER_COLUMN = 1000
"""Maximum number of listed faults of one column; further faults are only counted."""
_MAX_PLAUSIBLE = 1e12
"""Upper bound of plausible values of any column except seeds, far above the values of any trajectory."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a dataset."""

    file: str
    """File, relative to the dataset."""
    row: int | None
    """Row in the file or table, from 0; None if the fault concerns the whole file."""
    column: str
    """Column or property that is wrong."""
    found: str
    """Value found."""
    expected: str
    """Value expected."""
    n_faults: int = 1
    """Number of faults that this object represents; above 1 only in a summary of faults that are not listed."""

    @classmethod
    def of(cls, file: object, row: int | None, column: object, found: object, expected: object) -> "Fault":
        """Create a fault from untrusted values; they are shortened to one line without control characters."""
        return cls(
            shortened(one_line(file), 300),
            row,
            shortened(one_line(column)),
            shortened(one_line(found)) or "nothing",
            shortened(one_line(expected), 300),
        )

    @classmethod
    def from_error(cls, file: object, row: int | None, error: UserError) -> "Fault":
        """Create a fault from an error raised while reading."""
        return cls.of(file, row, error.field, error.found, error.expected)


class FaultList:
    """Collects faults: lists the first fault of each file and column, and counts the others.

    At most MAX_PER_COLUMN faults of a column are listed. This limits memory for datasets with a fault in each of
    millions of files.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, str, bool], Fault] = {}
        self._n_of_column: dict[str, int] = {}

    def add(self, fault: Fault) -> None:
        """Add a fault, unless a fault of this file and column is listed already."""
        key = fault.file, fault.column, fault.row is None
        if key in self._first:
            return
        n_earlier = self._n_of_column.get(fault.column, 0)
        self._n_of_column[fault.column] = n_earlier + fault.n_faults
        if n_earlier < MAX_PER_COLUMN and fault.n_faults == 1:
            self._first[key] = fault

    def add_made(self, column: str, make: Callable[[], Fault]) -> None:
        """Count a fault of a column; `make` creates the fault and is called only if it can be listed."""
        if self._n_of_column.get(column, 0) < MAX_PER_COLUMN:
            self.add(make())
        else:
            self._n_of_column[column] += 1

    def extend(self, faults: Iterable[Fault]) -> None:
        """Add faults in order."""
        for fault in faults:
            self.add(fault)

    def __len__(self) -> int:
        return len(self._first)

    def faults(self) -> list[Fault]:
        """Return the listed faults, then one summary for each column with faults that were only counted."""
        kept = dict.fromkeys(self._n_of_column, 0)
        for fault in self._first.values():
            kept[fault.column] += 1
        more = {column: n - kept[column] for column, n in self._n_of_column.items() if n > kept[column]}
        return [*self._first.values(), *(more_faults(column, n) for column, n in more.items())]


def more_faults(column: str, n_faults: int) -> Fault:
    """Return a fault that summarises the faults of a column that are not listed."""
    return Fault("...", None, column, f"{n_faults} more faults", "no faults; only the first ones are listed", n_faults)


def part_faults(dataset: Dataset, where: str, table: str) -> Iterator[Fault]:
    """Yield the faults of a part of a table that can be found without reading other parts."""
    path, stem = dataset.store.folder and dataset.store.folder / where, PurePosixPath(where).stem
    if path is not None and path.is_symlink():
        yield Fault.of(where, None, "part", "a link", "a regular file")
        return
    if not matches(PART_PATTERN, stem):
        yield Fault.of(where, None, "part", stem, f"a name like {PART_PATTERN}")
        return
    try:
        part = dataset.open_part(where, table)
        names, known = part.found.names, TABLES[table].names
        missing = set(known) - set(names) - set(MAY_BE_ABSENT.get(table, ()))
        odd = sorted({name for name in names if name not in known and not matches(_COLUMN, name)} | missing)
        # Unknown columns are ignored: a later version may have added them.
        present = [name for name in names if name in known]
        if odd or present != [name for name in known if name in names]:
            yield Fault.of(where, None, "schema", odd or "another order", f"the columns of {table}")
            return
        for found, expected in ((part.found.field(name), TABLES[table].field(name)) for name in present):
            if _definition(found) != _definition(expected):
                yield Fault.of(where, None, found.name, found.metadata, f"{expected.type} with {expected.metadata}")
        first_row = 0
        stated = part.stated_groups()
        for group in range(part.n_groups):
            rows = part.read(groups=[group], any_ids=True)
            for error in false_statistics(part, next(stated, {}), rows):
                yield Fault.from_error(where, first_row, error)
            yield from _name_faults(where, first_row, stem, rows)
            for field in rows.schema:
                yield from _value_faults(where, first_row, field, rows[field.name].combine_chunks())
            first_row += len(rows)
    except UserError as error:
        yield Fault.from_error(where, None, error)


def _definition(field: pa.Field) -> tuple[object, ...]:
    """Return the properties of a column that must agree; the description may differ between versions."""
    metadata = {key: value for key, value in (field.metadata or {}).items() if key != b"meaning"}
    return field.type, field.nullable, metadata


def _name_faults(where: str, first_row: int, stem: str, rows: pa.Table) -> Iterator[Fault]:
    """Yield a fault if a part has rows that do not fit its name, since readers select parts by name."""
    scene, _, trajectory = stem.partition(".")
    if is_whole(stem):
        return
    named_so = pc.equal(rows["scene_id"], scene)
    if trajectory and "trajectory_id" in rows.column_names:
        named_so = pc.and_(named_so, pc.equal(rows["trajectory_id"], trajectory))
    if "frame_id" in rows.column_names:
        prefix = f"{scene}/{trajectory}/" if trajectory else f"{scene}/"
        named_so = pc.and_(named_so, pc.starts_with(rows["frame_id"], prefix))
    others = np.flatnonzero(~np.asarray(named_so, bool))
    if len(others):
        row = first_row + int(others[0])
        yield Fault.of(where, row, "part", "a row of another scene or trajectory", f"only rows of {stem}")


def _value_faults(where: str, first_row: int, field: pa.Field, column: pa.Array) -> Iterator[Fault]:
    """Check one column for nulls, non-finite values, ranges, lengths of vectors and patterns of text."""
    present = ~np.asarray(column.is_null(), bool)
    if not field.nullable and not present.all():
        yield Fault.of(where, first_row + int(np.argmin(present)), field.name, "null", "a value")
        return
    checks: list[tuple[np.ndarray, str]] = []
    if pa.types.is_string(field.type):
        pattern = _PATTERNS.get(field.name, _PLAIN)
        fits = np.asarray(pc.fill_null(pc.match_substring_regex(column, pattern), False), bool)
        line_breaks = np.asarray(pc.fill_null(pc.match_substring(column, "\n"), False), bool)
        checks.append((~fits | line_breaks, f"text like {pattern}"))
        values = None
    elif pa.types.is_fixed_size_list(field.type):
        values = column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), field.type.list_size)
    else:
        values = column.fill_null(1).to_numpy(zero_copy_only=False).astype(np.float64)[:, None]
    if values is not None:
        checks.append((~(np.abs(values) < _MAX_PLAUSIBLE).all(axis=1) & (field.name != "seed"), "a finite number"))
        if field.name in _POSITIVE:
            checks.append((values[:, 0] <= 0, "above 0"))
        if field.name in _NOT_NEGATIVE:
            checks.append((values[:, 0] < 0, "at least 0"))
        if field.name in _RANGES:
            low, high = _RANGES[field.name]
            checks.append(((values[:, 0] < low) | (values[:, 0] > high), f"{low} to {high}"))
        if field.name in _UNIT_VECTORS:
            checks.append((np.abs(np.linalg.norm(values, axis=1) - 1) > 1e-6, "length 1"))
    for wrong, expected in checks:
        rows = np.flatnonzero(wrong & present)
        if len(rows):
            yield Fault.of(where, first_row + int(rows[0]), field.name, column[int(rows[0])].as_py(), expected)


def matches(pattern: str, text: object) -> bool:
    """Whether a pattern matches the whole text."""
    return isinstance(text, str) and re.fullmatch(pattern.removeprefix("^").removesuffix("$"), text) is not None
