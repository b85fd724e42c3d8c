"""Read the detections of any detector from a Parquet table. The table is untrusted input."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from perilune_shared.errors import UserError
from perilune_train.detect.evaluate.matching import Detections

COLUMNS = {
    "dataset": pa.string(),
    "frame_id": pa.string(),
    "x0_px": pa.float64(),
    "y0_px": pa.float64(),
    "x1_px": pa.float64(),
    "y1_px": pa.float64(),
    "score": pa.float64(),
}
"""Columns of a submission. A box holds the whole ellipse, also off the image; pixel 0 is from 0 to 1."""
_MOST_ROWS = 20_000_000
_BOX = ("x0_px", "y0_px", "x1_px", "y1_px")


def read_submission(path: Path, frames: dict[str, list[str]]) -> dict[str, list[Detections]]:
    """Detections by dataset, one entry for each of its frames; `frames` holds the frame_ids of each dataset.

    Frames without rows have no detections. Raises UserError if the file cannot be read, lacks a column, names another
    dataset or frame, or holds a number that is not finite, a box without area, or a score outside 0 to 1.
    """
    table = _read(path)
    _check_numbers(path, table)
    known = pa.array(sorted(frames), pa.string())
    wrong = table["dataset"].filter(pc.invert(pc.is_in(table["dataset"], known)))
    if len(wrong):
        raise UserError(path, "dataset", repr(wrong[0].as_py()), f"one of {', '.join(sorted(frames))}")
    return {
        name: _of_dataset(path, table.filter(pc.equal(table["dataset"], name)), ids) for name, ids in frames.items()
    }


def _read(path: Path) -> pa.Table:
    if not path.is_file():
        raise UserError(path, "detections", "no such file", "a Parquet file")
    try:
        file = pq.ParquetFile(path)
        if file.metadata.num_rows > _MOST_ROWS:
            raise UserError(path, "rows", file.metadata.num_rows, f"at most {_MOST_ROWS}")
        missing = [name for name in COLUMNS if name not in file.schema_arrow.names]
        if missing:
            raise UserError(path, "columns", f"no {', '.join(missing)}", ", ".join(COLUMNS))
        return file.read(columns=list(COLUMNS)).cast(pa.schema(list(COLUMNS.items())))
    except (pa.ArrowException, OSError) as error:
        raise UserError(path, "detections", error, "a Parquet file with numbers and texts") from None


def _check_numbers(path: Path, table: pa.Table) -> None:
    for name in COLUMNS:
        if table[name].null_count:
            raise UserError(path, name, "null", "a value in every row")
    numbers = {name: table[name].to_numpy() for name in (*_BOX, "score")}
    checks = {name: (np.isfinite(values), "a finite number") for name, values in numbers.items()}
    checks["x1_px"] = (checks["x1_px"][0] & (numbers["x1_px"] > numbers["x0_px"]), "a finite number above x0_px")
    checks["y1_px"] = (checks["y1_px"][0] & (numbers["y1_px"] > numbers["y0_px"]), "a finite number above y0_px")
    checks["score"] = ((numbers["score"] >= 0) & (numbers["score"] <= 1), "a number from 0 to 1")
    for name, (fits, expected) in checks.items():
        if not fits.all():
            row = int(fits.argmin())
            raise UserError(path, f"{name}: row {row}", numbers[name][row], expected)


def _of_dataset(path: Path, rows: pa.Table, frame_ids: list[str]) -> list[Detections]:
    """Detections of each frame, best first."""
    place = pc.index_in(rows["frame_id"], pa.array(frame_ids, pa.string()))
    if place.null_count:
        unknown = rows["frame_id"].filter(pc.is_null(place))[0].as_py()
        raise UserError(path, "frame_id", repr(unknown), f"a frame of {rows['dataset'][0].as_py()}")
    at = place.to_numpy().astype(np.intp)
    boxes = np.column_stack([rows[name].to_numpy() for name in _BOX]).reshape(-1, 4)
    scores = rows["score"].to_numpy()
    order = np.lexsort((-scores, at))
    bounds = np.searchsorted(at[order], np.arange(len(frame_ids) + 1))
    parts = (order[start:stop] for start, stop in pairwise(bounds))
    return [Detections(boxes[own], scores[own]) for own in parts]
