"""Check a dataset's frames, as files or packed, against the manifest."""

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from perilune_shared.dataset.manifest import LARGEST_FRAME_BYTES, Dataset
from perilune_shared.dataset.names import IMAGE_KINDS
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import IMAGES
from perilune_shared.errors import UserError
from perilune_shared.progress import Progress
from perilune_shared.storage import files
from perilune_shared.storage.png import png_header
from perilune_shared.validation.faults import Fault


def image_faults(dataset: Dataset, progress: Progress) -> Iterator[Fault]:
    """Yield missing frames and faults in size, header and hash of every frame's files or packed bytes."""
    info = dataset.info
    if info.images in ("absent", "planned"):
        return
    task = progress.add_task("hashing", total=info.counts.frames, unit="frames")
    columns = ["frame_id", *(f"{kind}_{name}" for kind in IMAGE_KINDS for name in ("path", "bytes", "sha256"))]
    for part in dataset.parts("frames"):
        where = part.relative_to(dataset.root).as_posix()
        first_row = 0
        for rows in _readable_groups(dataset, part, columns):
            places = {frame_id: first_row + row for row, frame_id in enumerate(rows["frame_id"].to_pylist())}
            records = rows.to_pylist()
            for row, frame in enumerate(records, first_row):
                for kind in IMAGE_KINDS if info.images == "files" else ():
                    if frame[f"{kind}_path"] is not None:
                        yield from _file_faults(dataset, frame, kind, row, where)
                progress.advance(task)
            if info.images == "packed":
                try:
                    for frame_id, png in dataset.pngs(rows):
                        row = places[frame_id]
                        sha256 = hashlib.sha256(png).hexdigest()
                        yield from _png_faults(dataset, png, len(png), sha256, records[row - first_row], row)
                except UserError as error:
                    yield Fault.from_error("images", None, error)
            first_row += len(rows)
    if info.images == "packed":
        yield from _shard_faults(dataset)


def _readable_groups(dataset: Dataset, part: Path, columns: list[str]) -> Iterator[pa.Table]:
    """Yield the readable row groups of a part of `frames`; `part_faults` reports the unreadable ones."""
    with contextlib.suppress(UserError):
        opened = dataset.open_part(part, "frames")
        for group in range(opened.n_groups):
            yield opened.read(columns, [group])


def _shard_faults(dataset: Dataset) -> Iterator[Fault]:
    known = set(dataset.table("frames", ["frame_id"])["frame_id"].to_pylist())
    found: set[str] = set()
    for shard in dataset.shards():
        where = shard.relative_to(dataset.root).as_posix()
        try:
            keys = Part(shard, "images", IMAGES).read(["frame_id"])["frame_id"].to_pylist()
        except UserError as error:
            yield Fault.from_error(where, None, error)
            continue
        odd = [key for key in keys if key not in known or key in found]
        if odd or len(set(keys)) != len(keys):
            yield Fault.of(
                where, None, "frame_id", (odd or ["a frame_id twice"])[0], "frames of the manifest, each once"
            )
        found |= set(keys)


def _file_faults(dataset: Dataset, frame: dict, kind: str, row: int, where: str) -> Iterator[Fault]:
    relative = frame[f"{kind}_path"]
    try:
        path = dataset.file(relative)
    except UserError as error:
        yield Fault.of(where, row, f"{kind}_path", error.found, error.expected)
        return
    if not path.is_file():
        yield Fault.of(relative, row, f"{kind}_path", "no such file", "the frame")
        return
    n_bytes = path.stat().st_size
    if n_bytes > LARGEST_FRAME_BYTES:
        yield Fault.of(relative, row, f"{kind}_bytes", n_bytes, f"at most {LARGEST_FRAME_BYTES}")
    elif n_bytes != frame[f"{kind}_bytes"]:
        yield Fault.of(relative, row, f"{kind}_bytes", n_bytes, frame[f"{kind}_bytes"])
    elif kind == "exr":
        if files.sha256_of(path) != frame["exr_sha256"]:
            yield Fault.of(relative, row, "exr_sha256", "a different SHA-256", frame["exr_sha256"])
    else:
        with path.open("rb") as stream:
            head = stream.read(64)
        yield from _png_faults(dataset, head, n_bytes, files.sha256_of(path), frame, row)


def _png_faults(dataset: Dataset, head: bytes, n_bytes: int, sha256: str, frame: dict, row: int) -> Iterator[Fault]:
    """Check a PNG's size, hash and header, given its first bytes."""
    where, camera = frame["png_path"], dataset.info.camera
    if n_bytes != frame["png_bytes"]:
        yield Fault.of(where, row, "png_bytes", n_bytes, frame["png_bytes"])
    if sha256 != frame["png_sha256"]:
        yield Fault.of(where, row, "png_sha256", "a different SHA-256", frame["png_sha256"])
    try:
        header = png_header(head)
    except ValueError as error:
        yield Fault.of(where, row, "png_path", error, "a grey PNG")
        return
    if (header.width_px, header.height_px) != (camera.width_px, camera.height_px):
        size = f"{header.width_px} x {header.height_px}"
        yield Fault.of(where, row, "width_px", size, f"{camera.width_px} x {camera.height_px}")
