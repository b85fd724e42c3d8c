"""Pack a dataset into few large files, and unpack it: PNGs in images/*.parquet, each table as one part."""

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import frame_path
from perilune_shared.dataset.packed import MOST_IMAGES_WRITTEN, write_packed
from perilune_shared.dataset.parts import MOST_ROWS_WRITTEN
from perilune_shared.dataset.writer import new_dataset, with_column
from perilune_shared.editing.rewrite import check_source, rewrite
from perilune_shared.errors import UserError
from perilune_shared.progress import NO_PROGRESS, Progress

_EXR_COLUMNS = ("exr_path", "exr_sha256", "exr_bytes")
_MAX_SHARD_MB = 8000
"""Maximum shard size, 10^6 bytes: larger files are refused on reading (perilune_shared.dataset.parts)."""
_ORDER = [("scene_id", "ascending"), ("trajectory_id", "ascending"), ("frame_index", "ascending")]


def pack(
    source: Dataset,
    out: Path,
    shard_mb: float = 1000,
    progress: Progress = NO_PROGRESS,
    *,
    most_rows: int = MOST_ROWS_WRITTEN,
    most_images: int = MOST_IMAGES_WRITTEN,
) -> None:
    """Write a packed dataset: frames in shards of about `shard_mb` megabytes, readable by Hugging Face `datasets`.

    A table of more than `most_rows` rows becomes several parts, and a shard contains at most `most_images` frames, to
    stay within the limits of readers (perilune_shared.dataset.parts). If the dataset has no frames, only its tables are
    packed. EXRs are not packed: their columns become null.
    """
    check_source(source, out, progress)
    if not 0 < shard_mb <= _MAX_SHARD_MB:
        raise UserError("--shard-mb", "size", shard_mb, f"above 0, at most {_MAX_SHARD_MB}")
    packed = source.info.images in ("files", "packed")
    info = source.info
    if packed:
        info = info.changed("packed", images="packed", exr_camera=None)
    frames = source.table("frames").sort_by(_ORDER)
    with new_dataset(out, info, whole_tables=True, most_rows=most_rows, progress=progress) as writer:
        for scene_id in source.scene_ids():
            tables = source.scene(scene_id)
            writer.add_scene({**tables, "frames": _without_exr(tables["frames"]) if packed else tables["frames"]})
        if packed:
            write_packed(writer.root, _images(source, frames, progress), round(shard_mb * 1e6), most_images)


def _images(source: Dataset, frames: pa.Table, progress: Progress) -> Iterator[tuple[str, str, bytes]]:
    task = progress.add_task("packing", total=len(frames), unit="frames")
    for frame_id, png in source.pngs(frames):
        yield frame_id, frame_path(frame_id, "png"), png
        progress.advance(task)


def unpack(source: Dataset, out: Path, progress: Progress = NO_PROGRESS, *, link: bool = False) -> None:
    """Write a dataset with a part for each scene and trajectory, and frames as files.

    Frames that already are files are copied, or hard-linked with `link`.
    """
    check_source(source, out, progress)
    info: DatasetInfo = source.info.changed("unpacked")
    rewrite(source, out, info, lambda tables: tables, "link" if link else "copy", progress)


def _without_exr(frames: pa.Table) -> pa.Table:
    for name in _EXR_COLUMNS:
        frames = with_column(frames, name, [None] * len(frames))
    return frames
