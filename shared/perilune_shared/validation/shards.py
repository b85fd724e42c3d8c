"""Check a dataset's shards against the manifest: names, rows, labels and images."""

from collections import defaultdict
from collections.abc import Iterator

import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.packed import FOLDER, open_shard, packed_rows, shard_name, split_of
from perilune_shared.dataset.schema import TABLES
from perilune_shared.dataset.statistics import false_statistics
from perilune_shared.errors import UserError
from perilune_shared.validation.faults import Fault
from perilune_shared.validation.images import png_faults


def shard_faults(dataset: Dataset, progress: Progress) -> Iterator[Fault]:
    """Yield the faults of packed frames.

    Each frame of the manifest must occur once, in a shard of its split, and be equal to its row there. Reads one row
    group at a time, together with the rows of its trajectories in the manifest.
    """
    task = progress.add_task("hashing", total=dataset.info.counts.frames, unit="frames")
    missing = set(dataset.table("frames", ["frame_id"])["frame_id"].to_pylist())
    shards = dataset.shards()
    for where in shards:
        try:
            shard = open_shard(dataset.store, where)
            first_row = 0
            stated = shard.stated_groups()
            for group in range(shard.n_groups):
                rows = shard.read(groups=[group])
                for error in false_statistics(shard, next(stated, {}), rows):
                    yield Fault.from_error(where, first_row, error)
                for row, frame_id in enumerate(rows["frame_id"].to_pylist(), first_row):
                    if frame_id not in missing:
                        yield Fault.of(where, row, "frame_id", frame_id, "frames of the manifest, each once")
                    missing.discard(frame_id)
                yield from _row_faults(dataset, rows, where, split_of(where), first_row)
                first_row += len(rows)
                progress.advance(task, len(rows))
        except UserError as error:
            yield Fault.from_error(where, None, error)
    if missing:
        yield Fault.of(FOLDER, None, "frame_id", f"no {min(missing)}", "every frame of the manifest")
    names = defaultdict(list)
    for path in shards:
        names[split_of(path)].append(path)
    for split, shard_names in names.items():
        expected = [shard_name(split, number, len(shard_names)) for number in range(len(shard_names))]
        if shard_names != expected:
            odd = next(name for name in shard_names if name not in expected)
            yield Fault.of(odd, None, "name", f"one of {len(shard_names)} shards of {split}", expected[0])


def _row_faults(dataset: Dataset, rows: pa.Table, where: str, split: str, first_row: int) -> Iterator[Fault]:
    """Compare a row group with the manifest; the caller reports rows of unknown frames."""
    frames, labels = _manifest_rows(dataset, rows)
    known = rows.filter(pc.is_in(rows["frame_id"], frames["frame_id"].combine_chunks()))
    frames = frames.take(pc.index_in(known["frame_id"], frames["frame_id"].combine_chunks()))
    expected = packed_rows(frames, labels, [None] * len(frames))
    for name in expected.column_names:
        packed = known[name] if name != "image" else pc.struct_field(known[name], "path")
        right = expected[name] if name != "image" else frames["png_path"]
        if not packed.equals(right.cast(packed.type)):
            pairs = enumerate(zip(packed.to_pylist(), right.to_pylist(), strict=True), first_row)
            row, (value, other) = next((row, pair) for row, pair in pairs if pair[0] != pair[1])
            column = "image.path" if name == "image" else name
            table = "labels" if name == "labels" else "frames"
            yield Fault.of(where, row, column, value, f"{other}, as in the table {table}")
    for row, frame in enumerate(frames.to_pylist(), first_row):
        if frame["split"] != split:
            yield Fault.of(where, row, "split", frame["split"], f"{split}, as in the name of the shard")
        png = known["image"][row - first_row]["bytes"].as_py() or b""
        yield from png_faults(dataset, png, frame, row, where)


def _manifest_rows(dataset: Dataset, rows: pa.Table) -> tuple[pa.Table, pa.Table]:
    """Return the rows of the tables `frames` and `labels` for all trajectories in a row group."""
    keys = rows.group_by(["scene_id", "trajectory_id"]).aggregate([]).to_pylist()
    tables = []
    for name in ("frames", "labels"):
        of_trajectories = [
            dataset.table(name, scene_id=key["scene_id"], trajectory_id=key["trajectory_id"]) for key in keys
        ]
        empty = TABLES[name].empty_table().replace_schema_metadata()
        tables.append(pa.concat_tables([empty, *of_trajectories]))
    return tables[0], tables[1]
