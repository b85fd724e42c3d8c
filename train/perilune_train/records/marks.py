"""Mark the output of an evaluation visibly if the network was trained, selected or calibrated on its terrain."""

import textwrap
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq

from perilune_shared.export.foreign_text import for_markdown
from perilune_shared.storage.files import written_aside
from perilune_train.records.markdown import write_markdown
from perilune_train.records.pictures import save_image

_METADATA_KEY = b"terrain_mark"
_RED, _WHITE = (32, 32, 200), (255, 255, 255)
_CHARACTER_PX, _LINE_PX = 9, 22


def mark_files(folder: Path, names: Iterable[str], mark: str) -> None:
    """Mark pictures (in a red band at the top), Markdown pages and Parquet tables (in their metadata) of a folder.

    Skips files that do not exist. Does nothing if `mark` is empty.
    """
    unmarked = [folder / name for name in names if mark and (folder / name).is_file()]
    try:
        while unmarked:
            _mark_file(unmarked[0], mark)
            del unmarked[0]
    finally:
        # If writing fails, for example on a full disk, no file may remain without its mark.
        for path in unmarked:
            path.unlink(missing_ok=True)


def _mark_file(path: Path, mark: str) -> None:
    if path.suffix == ".png":
        mark_picture(path, mark)
    elif path.suffix == ".md":
        write_markdown(path, marked_page(path.read_text(encoding="utf-8"), mark))
    else:
        mark_table(path, mark)


def mark_table(path: Path, mark: str) -> None:
    """Write `mark` into the schema metadata of a Parquet file, under the key `terrain_mark`."""
    table = pq.read_table(path)
    metadata = {**(table.schema.metadata or {}), _METADATA_KEY: mark.encode()}
    with written_aside(path) as aside:
        pq.write_table(table.replace_schema_metadata(metadata), aside, compression="zstd")


def mark_picture(path: Path, mark: str) -> None:
    """Add a red band with `mark` in white above a PNG. Raises OSError if the file cannot be read or written."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise OSError(f"{path}: cannot be read")
    width = image.shape[1]
    lines = textwrap.wrap(mark, max(width // _CHARACTER_PX - 1, 8))
    band = np.full((_LINE_PX * len(lines) + 8, width, 3), _RED, np.uint8)
    for number, line in enumerate(lines):
        cv2.putText(band, line, (6, _LINE_PX * (number + 1) - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)
    save_image(path, np.concatenate([band, image]))


def marked_page(text: str, mark: str) -> str:
    """Add the mark below the title of a Markdown page, and the first words of the mark to each section heading."""
    short = mark.split(":")[0].split(",")[0]
    lines: list[str] = []
    for line in text.split("\n"):
        if line.startswith("## "):
            line = f"{line} ({for_markdown(short)})"
        lines.append(line)
        if line.startswith("# "):
            lines += ["", f"**{for_markdown(mark)}**"]
    return "\n".join(lines)
