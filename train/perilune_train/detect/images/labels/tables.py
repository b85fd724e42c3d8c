"""Tables of boxes beside the images: X, Y, W, H in pixels, separated by commas or tabs."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_train.detect.images.labels.boxes import Box, box_of
from perilune_train.detect.images.labels.texts import read_text

_COLUMNS = ("X", "Y", "W", "H")


def read_table(path: Path) -> NDArray[np.float64]:
    """Boxes (M, 4) of a table with a header. Raises UserError on an invalid row."""
    text = read_text(path, "boxes")
    rows = ((n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip())
    header = next(rows, (1, ""))[1]
    separator = "\t" if "\t" in header else ","
    names = [name.strip().upper() for name in header.split(separator)]
    for column in _COLUMNS:
        if column not in names:
            raise UserError(path, "line 1", header or "no header", f"a column {column}, as in ID,X,Y,W,H,C_X,CY")
    columns = [names.index(column) for column in _COLUMNS]
    boxes: list[Box] = []
    for number, line in rows:
        cells = line.split(separator)
        if len(cells) != len(names):
            raise UserError(path, f"line {number}", f"{len(cells)} values", f"{len(names)}, as in the header")
        boxes.append(box_of([cells[column] for column in columns], path, f"line {number}", may_be_empty=False))
    return np.array(boxes, np.float64).reshape(-1, 4)
