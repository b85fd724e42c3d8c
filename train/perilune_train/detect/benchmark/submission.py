"""Read the detections of any detector from a Parquet or CSV table. The table is untrusted input."""

from itertools import pairwise
from pathlib import Path

import numpy as np

from perilune_shared.storage.tables.columns import Columns, Kind, Texts
from perilune_shared.storage.tables.limits import DETECTIONS
from perilune_shared.storage.tables.read import read_table
from perilune_train.detect.evaluate.matching import Detections

COLUMNS: dict[str, Kind] = {
    "dataset": "text",
    "frame_id": "text",
    "x0_px": "number",
    "y0_px": "number",
    "x1_px": "number",
    "y1_px": "number",
    "score": "number",
}
"""Columns of a submission. A box contains the whole ellipse, including any part outside the image. The first pixel
extends from 0 to 1 in x and in y."""
_BOX = ("x0_px", "y0_px", "x1_px", "y1_px")


def read_submission(path: Path, frames: dict[str, list[str]]) -> dict[str, list[Detections]]:
    """Read the detections of each dataset, as a list with one entry per frame.

    `frames` has the frame_ids of each dataset. Each returned list has the order of these ids. A frame without rows in
    the table has no detections.

    Raises UserError if the file cannot be read, lacks a column, names another dataset or frame, or contains a number
    that is not finite, a box without area, or a score outside 0 to 1.
    """
    table = read_table(path, DETECTIONS, COLUMNS)
    _check_numbers(table)
    datasets, ids = table.texts("dataset"), table.texts("frame_id")
    of_dataset = _known(datasets, list(frames))
    table.check("dataset", of_dataset >= 0, f"one of {', '.join(sorted(frames))}")
    by_dataset = {}
    for number, (name, frame_ids) in enumerate(frames.items()):
        rows = np.flatnonzero(of_dataset == number)
        frame = _known(ids, frame_ids)[rows]
        if (frame < 0).any():
            raise table.fault(int(rows[(frame < 0).argmax()]), "frame_id", f"a frame of {name}")
        by_dataset[name] = _of_dataset(table, rows, frame, len(frame_ids))
    return by_dataset


def _known(texts: Texts, names: list[str]) -> np.ndarray:
    """Index in `names` of each row's text; -1 for other texts."""
    number_of = {name: k for k, name in enumerate(names)}
    return np.array([*(number_of.get(word, -1) for word in texts.words), -1], np.int64)[texts.codes]


def _check_numbers(table: Columns) -> None:
    x0, y0, x1, y1 = (table.finite(name) for name in _BOX)
    table.check("x1_px", x1 > x0, "a finite number above x0_px")
    table.check("y1_px", y1 > y0, "a finite number above y0_px")
    table.finite("score", 0, 1)


def _of_dataset(table: Columns, rows: np.ndarray, frame: np.ndarray, n_frames: int) -> list[Detections]:
    """Detections of each frame of a dataset, best first.

    `rows` (n,) are the dataset's rows of the table, and `frame` (n,) is the index of each row's frame.
    """
    boxes = np.column_stack([table.numbers(name)[rows] for name in _BOX]).reshape(-1, 4)
    scores = table.numbers("score")[rows]
    order = np.lexsort((-scores, frame))
    bounds = np.searchsorted(frame[order], np.arange(n_frames + 1))
    parts = (order[start:stop] for start, stop in pairwise(bounds))
    return [Detections(boxes[chosen], scores[chosen]) for chosen in parts]
