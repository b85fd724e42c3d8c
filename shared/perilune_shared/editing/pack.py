"""Pack a dataset into shards for streaming (frames with pose, image and labels), and unpack it."""

from collections.abc import Iterator, Sequence

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import SCENE_FILE_KINDS, SPLITS
from perilune_shared.dataset.packed import LABEL, SHARDS, packed_rows, shard_name
from perilune_shared.dataset.parts import MAX_ROWS_WRITTEN
from perilune_shared.dataset.schema import TABLES
from perilune_shared.editing.rewrite import Rewriting, check_source, rewrite
from perilune_shared.editing.writer import DatasetWriter, new_dataset, with_column, with_new_paths
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address

MAX_FRAMES_WRITTEN = 100_000
"""Maximum number of frames of a shard; a shard then has far fewer row groups than readers accept."""
_MAX_SHARD_MB = 2000
_FRAMES_PER_GROUP, _BYTES_PER_GROUP = 64, 2**23
"""Maximum frames and bytes of a row group. A stream reads and shuffles whole row groups."""
_NOT_PACKED = [f"{kind}_{name}" for kind in ("exr", "lidar") for name in ("path", "sha256", "bytes")]
_NOT_PACKED_OF_SCENES = [f"{kind}_{name}" for kind in SCENE_FILE_KINDS for name in ("path", "sha256", "bytes")]
_ORDER = [("scene_id", "ascending"), ("trajectory_id", "ascending"), ("frame_index", "ascending")]


def pack(
    source: Dataset,
    out: Address,
    shard_mb: float = 128,
    progress: Progress = NO_PROGRESS,
    *,
    max_rows: int = MAX_ROWS_WRITTEN,
    max_frames: int = MAX_FRAMES_WRITTEN,
) -> None:
    """Write a packed dataset, with frames in shards of about `shard_mb` megabytes (10^6 bytes).

    Hugging Face `datasets` can read the shards. A shard contains at most `max_frames` frames of one split, ordered by
    scene, trajectory and frame index. Each table becomes one part, or several parts of at most `max_rows` rows. If the
    dataset has no frames, only its tables are packed. EXRs, flash lidar images and hazard maps are not packed; their
    columns become null.
    """
    check_source(source, out, progress)
    if not 0 < shard_mb <= _MAX_SHARD_MB:
        raise UserError("--shard-mb", "", shard_mb, f"above 0, at most {_MAX_SHARD_MB}")
    packed = source.info.images in ("files", "packed")
    info = source.info
    if packed:
        info = info.changed("packed", images="packed", exr_camera=None, exr_cameras=None)
    with new_dataset(out, info, max_rows=max_rows) as writer:
        for scene_id in source.scene_ids():
            tables = source.scene(scene_id)
            if packed:
                tables["frames"] = _without(_NOT_PACKED, tables["frames"])
                tables["scenes"] = _without(_NOT_PACKED_OF_SCENES, tables["scenes"])
            writer.add_scene(tables)
        if packed:
            task = progress.add_task("packing", total=source.info.counts.frames, unit="frames")
            for split in SPLITS:
                sizes = _sizes(source, split, shard_mb * 1e6, max_frames)
                for n_frames in _write_shards(source, writer, split, sizes):
                    progress.advance(task, n_frames)


def _write_shards(source: Dataset, writer: DatasetWriter, split: str, shards: list[list[int]]) -> Iterator[int]:
    """Write the shards of one split; yield the number of frames of each written row group.

    `shards` has, for each shard, the number of frames of each row group.
    """
    groups = _groups(source, split, [size for shard in shards for size in shard])
    for number, shard in enumerate(shards):
        text = [field.name for field in SHARDS if pa.types.is_string(field.type)]
        sink = pa.BufferOutputStream()
        with pq.ParquetWriter(sink, SHARDS, compression="zstd", use_dictionary=text) as file:
            for n_frames, rows in zip(shard, groups, strict=False):
                file.write_table(rows)
                yield n_frames
        writer.add_file(shard_name(split, number, len(shards)), sink.getvalue().to_pybytes())


def _sizes(source: Dataset, split: str, shard_bytes: float, max_frames: int) -> list[list[int]]:
    """Return, for each shard of a split, the number of frames of each row group."""
    frames = source.table("frames", ["scene_id", "trajectory_id", "frame_index", "png_bytes"], split=split)
    counts = source.info.counts
    label_bytes = sum(field.type.bit_width // 8 for field in LABEL) * counts.labels / max(counts.frames, 1)
    shards: list[list[int]] = []
    in_group = in_shard = group_bytes = bytes_so_far = 0.0
    for png_bytes in frames.sort_by(_ORDER)["png_bytes"].to_pylist():
        n_bytes = (png_bytes or 0) + label_bytes
        if not shards or bytes_so_far + n_bytes > shard_bytes or in_shard == max_frames:
            shards.append([0])
            in_group = in_shard = group_bytes = bytes_so_far = 0
        elif in_group == _FRAMES_PER_GROUP or group_bytes + n_bytes > _BYTES_PER_GROUP:
            shards[-1].append(0)
            in_group = group_bytes = 0
        shards[-1][-1] += 1
        in_group, in_shard = in_group + 1, in_shard + 1
        group_bytes, bytes_so_far = group_bytes + n_bytes, bytes_so_far + n_bytes
    return shards


def _groups(source: Dataset, split: str, sizes: Sequence[int]) -> Iterator[pa.Table]:
    """Yield row groups of a split with `sizes` frames. Holds only a few trajectories in memory."""
    trajectories = _trajectories(source, split)
    frames, labels = TABLES["frames"].empty_table(), TABLES["labels"].empty_table()
    for size in sizes:
        while len(frames) < size:
            more, more_labels = next(trajectories)
            frames, labels = pa.concat_tables([frames, more]), pa.concat_tables([labels, more_labels])
        chosen, frames = frames[:size], frames[size:]
        pngs = dict(source.pngs(chosen))
        yield packed_rows(with_new_paths(chosen), labels, [pngs[name] for name in chosen["frame_id"].to_pylist()])
        labels = labels.filter(pc.is_in(labels["frame_id"], frames["frame_id"].combine_chunks()))


def _trajectories(source: Dataset, split: str) -> Iterator[tuple[pa.Table, pa.Table]]:
    """Yield frames and labels of each trajectory of a split.

    Frames are sorted. Their columns for EXRs and flash lidar images are null.
    """
    columns = ["scene_id", "trajectory_id", "split"]
    for row in source.table("trajectories", columns).sort_by(_ORDER[:2]).to_pylist():
        if row["split"] in (split, None):
            keys = row["scene_id"], row["trajectory_id"], split
            frames = source.table("frames", None, *keys).replace_schema_metadata(TABLES["frames"].metadata)
            labels = source.table("labels", None, *keys).replace_schema_metadata(TABLES["labels"].metadata)
            yield _without(_NOT_PACKED, frames.sort_by(_ORDER)), labels


def unpack(source: Dataset, out: Address, progress: Progress = NO_PROGRESS, *, link: bool = False) -> None:
    """Write a dataset with each frame in its own file.

    If the frames of the source are files already, copy them, or hard-link them with `link`.
    """
    check_source(source, out, progress)
    info: DatasetInfo = source.info.changed("unpacked")
    rewrite(source, out, Rewriting(info, lambda tables: tables, "link" if link else "copy"), progress)


def _without(columns: Sequence[str], rows: pa.Table) -> pa.Table:
    for name in columns:
        rows = with_column(rows, name, [None] * len(rows))
    return rows
