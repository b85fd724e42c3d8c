"""Compare a trace of another implementation with a reference."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array
from perilune_shared.storage.tables.columns import Columns, Kind
from perilune_shared.storage.tables.limits import RUN_TABLE
from perilune_shared.storage.tables.read import open_table
from perilune_train.landing.trace.columns import EXACT, TABLES, Column, Table


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison of one table."""

    table: str
    """Name of the table."""
    n_rows: int
    """Number of rows of the reference."""
    n_columns: int
    """Number of compared columns, without keys."""
    of_columns: int
    """Number of columns of the reference, without keys."""
    largest: float
    """Largest difference, divided by its scale."""
    difference: str
    """The first difference beyond the tolerance, as text; empty if there is none."""


def compare_traces(reference: Path, trace: Path, tolerance: float) -> list[Compared]:
    """Compare the tables of the folder `trace` with the folder `reference`, table by table.

    Stops after the first table with a difference beyond the tolerance. Tables and columns that `trace` lacks are not
    compared. Raises UserError if a folder has no table of a trace, or on a table that cannot be read.
    """
    for folder in (reference, trace):
        if not any(_path(folder, table) for table in TABLES):
            expected = "a folder with " + ", ".join(f"{table.name}.parquet" for table in TABLES)
            raise UserError(folder, "tables", "none" if folder.is_dir() else "no such folder", expected)
    done: list[Compared] = []
    for table in TABLES:
        theirs = _path(trace, table)
        if theirs is None:
            continue
        ours = _path(reference, table)
        if ours is None:
            raise UserError(reference, "tables", f"no {table.name}.parquet", f"the reference of {theirs}")
        done.append(_compared(_read(ours, table), _read(theirs, table), table, tolerance))
        if done[-1].difference:
            break
    return done


def _path(folder: Path, table: Table) -> Path | None:
    """The file of a table, Parquet or CSV; None if there is none."""
    paths = (folder / f"{table.name}{suffix}" for suffix in (".parquet", ".csv"))
    return next((path for path in paths if path.is_file()), None)


def _read(path: Path, table: Table) -> Columns:
    kinds: dict[str, Kind] = dict.fromkeys(table.keys, "integer")
    for name, (column, _) in table.flat().items():
        kinds[name] = "text" if column.is_text else "integer" if _is_exact(column) else "number"
    with open_table(path, RUN_TABLE) as opened:
        columns = opened.read(kinds, table.keys)
    if not any(name in columns for name in table.flat()):
        raise UserError(path, "columns", "only keys", f"a column such as {next(iter(table.flat()))}")
    return columns


def _is_exact(column: Column) -> bool:
    return column.scale == EXACT and not column.variances


def _compared(ours: Columns, theirs: Columns, table: Table, tolerance: float) -> Compared:
    names = [name for name in table.flat() if name in theirs]
    missing = [name for name in names if name not in ours]
    if missing:
        raise UserError(ours.path, "columns", f"no {missing[0]}", f"the columns of {theirs.path}")
    place = _places(theirs, table)
    wanted = _keys(ours, table)
    lost = next((k for k, key in enumerate(wanted) if key not in place), None)
    extra = next((key for key in place if key not in set(wanted)), None)
    known = np.array([k for k, key in enumerate(wanted) if key in place], np.int64)
    rows = np.array([place[wanted[k]] for k in known], np.int64)
    share = np.zeros((len(known), len(names)))
    for n, name in enumerate(names):
        share[:, n] = _differences(ours, theirs, (known, rows), table, name)
    largest = float(share.max(initial=0.0))
    beyond = np.argwhere(share > tolerance)
    difference = ""
    if len(beyond) and (lost is None or known[beyond[0, 0]] < lost):
        row, n = beyond[0]
        k, name = int(known[row]), names[n]
        got, expected = (_text(columns, name, at) for columns, at in ((theirs, int(rows[row])), (ours, k)))
        by = "" if np.isinf(share[row, n]) else f", a difference of {share[row, n]:.2g} of its scale"
        difference = f"{_name(table, wanted[k])}: {name}: got {got}, expected {expected}{by}"
    elif lost is not None:
        difference = f"{_name(table, wanted[lost])}: no such row"
    elif extra is not None:
        difference = f"{_name(table, extra)}: a row that the reference lacks"
    return Compared(
        table.name, ours.n_rows, len(names), len([n for n in table.flat() if n in ours]), largest, difference
    )


def _keys(columns: Columns, table: Table) -> list[tuple[int, ...]]:
    return list(zip(*(columns.integers(key).tolist() for key in table.keys), strict=True))


def _places(columns: Columns, table: Table) -> dict[tuple[int, ...], int]:
    """Row of each key. Raises UserError if a key occurs twice."""
    place: dict[tuple[int, ...], int] = {}
    for row, key in enumerate(_keys(columns, table)):
        if key in place:
            raise UserError(*columns.at(row, table.keys[-1]), _name(table, key) + " again", "each row once")
        place[key] = row
    return place


def _name(table: Table, key: tuple[int, ...]) -> str:
    return f"{table.name}: " + ", ".join(f"{name} {value}" for name, value in zip(table.keys, key, strict=True))


def _text(columns: Columns, name: str, row: int) -> str:
    values = columns.arrays[name]
    return repr(values[row].item()) if isinstance(values, np.ndarray) else (values[row] or "nothing")


def _differences(
    ours: Columns,
    theirs: Columns,
    rows: tuple[NDArray[np.int64], NDArray[np.int64]],
    table: Table,
    name: str,
) -> Array:
    """Differences (n,) in a column, divided by the scale; infinite for texts, whole numbers and NaN that differ.

    `rows` are the rows of the reference and of the other trace.
    """
    column, variances = table.flat()[name]
    if column.is_text:
        mine, other = ours.texts(name).to_list(), theirs.texts(name).to_list()
        return np.array([0.0 if mine[k] == other[m] else np.inf for k, m in zip(*rows, strict=True)])
    expected, got = ours.numbers(name)[rows[0]], theirs.numbers(name)[rows[1]]
    if _is_exact(column):
        return np.where(expected == got, 0.0, np.inf)
    scale = np.maximum(column.scale, np.abs(expected))
    if variances:
        scale = np.sqrt(np.prod([ours.numbers(each)[rows[0]] for each in variances.split()], axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.abs(got - expected) / scale
    # A variance of exactly 0 has no scale: errors that the filter knows to be zero.
    share = np.where(expected == got, 0.0, share)
    return np.where(np.isnan(expected) & np.isnan(got), 0.0, np.where(np.isnan(share), np.inf, share))
