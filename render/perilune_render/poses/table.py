"""Read the table of a file of poses as text: CSV, TUM or Parquet, with what its header states and its lines."""

import csv
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from perilune_shared.errors import UserError

SITE_FROM_CAMERA = "site_from_camera"
"""What a header states of a rotation in this direction; that of every TUM file."""
_TUM = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_KEYS = ("frame", "rotation", "origin_m", "site")
_MAX_BYTES = 500_000_000
Table = tuple[pd.DataFrame, dict[str, str], np.ndarray | None]
"""Table, what the header states, and the line of each row."""


def read_table(path: Path) -> Table:
    """The table of a file. Raises UserError if it cannot be read."""
    if not path.is_file():
        raise UserError(path, "poses", "no such file", "a file .csv, .parquet or .tum")
    if path.stat().st_size > _MAX_BYTES:
        raise UserError(path, "size", f"{path.stat().st_size} bytes", f"at most {_MAX_BYTES}")
    readers = {".csv": _read_csv, ".parquet": _read_parquet, ".tum": _read_tum, ".txt": _read_tum}
    if path.suffix not in readers:
        raise UserError(path, "format", path.suffix or "none", ".csv, .parquet or .tum")
    return readers[path.suffix](path)


def _read_csv(path: Path) -> Table:
    lines = _text(path).split("\n")
    n_comments = next((n for n, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    stated = _stated(path, lines[:n_comments])
    reader = csv.reader(lines[n_comments:], skipinitialspace=True)
    kept: list[tuple[int, list[str]]] = []
    try:
        for words in reader:
            if words not in ([], [""]):
                kept.append((n_comments + reader.line_num, words))
    except csv.Error as error:
        raise UserError(path, f"line {n_comments + reader.line_num}", error, "values separated by commas") from None
    if not kept:
        raise UserError(path, "table", "no line", "a line with the names of the columns, then one line for each pose")
    names = [name.strip() for name in kept.pop(0)[1]]
    for n, words in kept:
        if len(words) != len(names):
            raise UserError(path, f"line {n}", f"{len(words)} values", f"{len(names)}, one for each column")
    return _table(kept, names, stated)


def _read_tum(path: Path) -> Table:
    lines = _text(path).split("\n")
    kept = [(n, line.split()) for n, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    for n, words in kept:
        if len(words) != len(_TUM):
            raise UserError(path, f"line {n}", f"{len(words)} values", "timestamp tx ty tz qx qy qz qw")
    stated = _stated(path, [line for line in lines if line.startswith("#")])
    if stated.get("rotation", SITE_FROM_CAMERA) != SITE_FROM_CAMERA:
        raise UserError(path, "rotation", stated["rotation"], f"{SITE_FROM_CAMERA}, as in every TUM file")
    return _table(kept, list(_TUM), stated | {"rotation": SITE_FROM_CAMERA})


def _table(kept: list[tuple[int, list[str]]], names: list[str], stated: dict[str, str]) -> Table:
    """The table of lines with their numbers and words."""
    table = pd.DataFrame([words for _, words in kept], columns=names, dtype=object)
    return table, stated, np.array([n for n, _ in kept], int)


def _read_parquet(path: Path) -> Table:
    try:
        read = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise UserError(path, "Parquet", error, "a Parquet file") from None
    metadata = {
        key.decode(errors="replace"): value.decode(errors="replace")
        for key, value in (read.schema.metadata or {}).items()
    }
    return read.to_pandas(), {key: metadata[key] for key in _KEYS if key in metadata}, None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(path, "text", "bytes that are not UTF-8", "a text file") from None


def _stated(path: Path, comments: list[str]) -> dict[str, str]:
    """What comment lines `# key: value` state; other comments are ignored."""
    found = {}
    for line in comments:
        key, colon, value = line.lstrip("#").partition(":")
        if colon and key.strip() in _KEYS:
            found[key.strip()] = value.strip()
    return found
