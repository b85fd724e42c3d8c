"""Check the files of a dataset's frames against the manifest."""

import contextlib
import hashlib
from collections.abc import Iterator

import pyarrow as pa

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import LARGEST_FRAME_BYTES, Dataset
from perilune_shared.dataset.names import IMAGE_KINDS
from perilune_shared.errors import UserError
from perilune_shared.storage.png import png_header
from perilune_shared.validation.faults import Fault


def image_faults(dataset: Dataset, progress: Progress) -> Iterator[Fault]:
    """Yield a fault for each frame file that is missing or has a wrong size, header or hash."""
    task = progress.add_task("hashing", total=dataset.info.counts.frames, unit="frames")
    columns = [
        "frame_id",
        "camera",
        *(f"{kind}_{name}" for kind in IMAGE_KINDS for name in ("path", "bytes", "sha256")),
    ]
    for where in dataset.parts("frames"):
        first_row = 0
        for rows in _readable_groups(dataset, where, columns):
            for row, frame in enumerate(rows.to_pylist(), first_row):
                for kind in IMAGE_KINDS:
                    if frame[f"{kind}_path"] is not None:
                        yield from _file_faults(dataset, frame, kind, row, where)
                progress.advance(task)
            first_row += len(rows)


def _readable_groups(dataset: Dataset, part: str, columns: list[str]) -> Iterator[pa.Table]:
    """Yield the readable row groups of a part of `frames`; `part_faults` reports the unreadable ones."""
    with contextlib.suppress(UserError):
        opened = dataset.open_part(part, "frames")
        for group in range(opened.n_groups):
            yield opened.read(columns, [group])


def _file_faults(dataset: Dataset, frame: dict, kind: str, row: int, where: str) -> Iterator[Fault]:
    relative = frame[f"{kind}_path"]
    try:
        content = dataset.store.read(relative, most_bytes=LARGEST_FRAME_BYTES)
    except UserError as error:
        if error.field == "path":
            yield Fault.of(where, row, f"{kind}_path", error.found, error.expected)
        else:
            column = f"{kind}_bytes" if error.field == "size" else f"{kind}_path"
            yield Fault.of(relative, row, column, error.found, error.expected)
        return
    if len(content) != frame[f"{kind}_bytes"]:
        yield Fault.of(relative, row, f"{kind}_bytes", len(content), frame[f"{kind}_bytes"])
    elif kind != "png":
        if hashlib.sha256(content).hexdigest() != frame[f"{kind}_sha256"]:
            yield Fault.of(relative, row, f"{kind}_sha256", "a different SHA-256", frame[f"{kind}_sha256"])
    else:
        yield from png_faults(dataset, content, frame, row, relative)


def png_faults(dataset: Dataset, png: bytes, frame: dict, row: int, where: str) -> Iterator[Fault]:
    """Yield the faults of a PNG in size, hash and header; `where` is the file to report.

    `frame` is the row of the PNG in the table `frames`, and `row` its number to report.
    """
    if len(png) != frame["png_bytes"]:
        yield Fault.of(where, row, "png_bytes", len(png), frame["png_bytes"])
    if hashlib.sha256(png).hexdigest() != frame["png_sha256"]:
        yield Fault.of(where, row, "png_sha256", "a different SHA-256", frame["png_sha256"])
    try:
        header = png_header(png)
    except ValueError as error:
        yield Fault.of(where, row, "png_path", error, "a grey PNG")
        return
    camera = dataset.camera_of(frame)
    if (header.width_px, header.height_px) != (camera.width_px, camera.height_px):
        size = f"{header.width_px} x {header.height_px}"
        yield Fault.of(where, row, "width_px", size, f"{camera.width_px} x {camera.height_px}")
