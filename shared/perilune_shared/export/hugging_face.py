"""Export to Hugging Face: Parquet files of each split; a row has a frame's image, pose and labels.

The tables of a dataset mix frames of all splits and keep labels separate from frames. The library `datasets` would read
all tables as training data. From this export, `datasets.load_dataset(folder)` loads all splits and
`load_dataset(folder, split="test")` loads one. Format: https://huggingface.co/docs/hub/datasets-manual-configuration.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import IMAGE_KINDS, SPLITS
from perilune_shared.dataset.packed import IMAGE, LABEL, features_of
from perilune_shared.dataset.schema import TABLES
from perilune_shared.export.card_head import head_of
from perilune_shared.export.rows import Choice, SceneRows, count_frames, scenes_of
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.store import Address

_OMITTED = ("split", "camera", *(f"{kind}_{name}" for kind in IMAGE_KINDS for name in ("path", "sha256", "bytes")))
_LABEL = pa.struct([*(pa.field(field.name, field.type) for field in LABEL), pa.field("chosen", pa.bool_())])
_FRAMES_PER_GROUP = 128


def export_hugging_face(
    dataset: Dataset,
    out: Address,
    progress: Progress,
    split: str | None = None,
    choose: Choice | None = None,
    shard_mb: float = 500,
) -> int:
    """Write data/<split>/*.parquet and a README.md that lists the splits into `out`.

    Returns the number of frames. All labels are written; the field `chosen` of a label states whether `choose` selects
    it. `shard_mb` is the approximate maximum size of a Parquet file, 10^6 bytes. Raises UserError if `out` is not
    empty, an image is missing or the split has no frames.
    """
    task = progress.add_task("huggingface", total=count_frames(dataset, split), unit="frames")
    writers: dict[str, _Shards] = {}
    n_frames = 0
    with new_files(out) as folder:
        try:
            for scene in scenes_of(dataset, split, choose):
                for name, rows in _tables(dataset, scene):
                    if name not in writers:
                        writers[name] = _Shards(folder / "data" / name, round(shard_mb * 1e6))
                    writers[name].write(rows)
                    n_frames += len(rows)
                    progress.advance(task, len(rows))
        finally:
            for writer in writers.values():
                writer.close()
        splits = [{"split": name, "path": f"data/{name}/*.parquet"} for name in SPLITS if name in writers]
        page = head_of(dataset, [{"config_name": "default", "data_files": splits}]) + _PAGE
        files.write_text(folder / "README.md", page)
    return n_frames


_PAGE = """

Rendered images of lunar landing trajectories. Each row is a frame with its image, camera pose and labels (crater
ellipses). The column names contain the units. The metadata of the Parquet files has the meaning of each column.

```python
from datasets import load_dataset

test = load_dataset("FOLDER", split="test")
```
"""


def schema_of() -> pa.Schema:
    """Return the schema of the files: columns of the table `frames`, the image, and the list of labels."""
    columns = [TABLES["frames"].field("frame_id"), IMAGE]
    columns += [field for field in TABLES["frames"] if field.name not in ("frame_id", *_OMITTED)]
    columns.append(pa.field("labels", pa.list_(_LABEL), metadata={"unit": "", "meaning": "craters in the frame"}))
    return pa.schema(columns, metadata={"huggingface": features_of(columns)})


def _tables(dataset: Dataset, scene: SceneRows) -> Iterator[tuple[str, pa.Table]]:
    """Yield batches of a scene's frames: the split, and rows in the schema of the files."""
    schema = schema_of()
    for split, frames in scene.frames.groupby("split"):
        for start in range(0, len(frames), _FRAMES_PER_GROUP):
            batch = frames.iloc[start : start + _FRAMES_PER_GROUP]
            pngs = dict(dataset.pngs(pa.Table.from_pandas(batch[["frame_id", "png_path"]], preserve_index=False)))
            images = [{"bytes": pngs[name], "path": f"{name}.png"} for name in batch["frame_id"]]
            columns = {
                "image": pa.array(images, schema.field("image").type),
                "labels": _labels(scene.labels, batch["frame_id"]),
            }
            for field in schema:
                if field.name not in columns:
                    columns[field.name] = pa.array(batch[field.name].tolist(), field.type, from_pandas=True)
            yield str(split), pa.table([columns[name] for name in schema.names], schema=schema)


def _labels(labels: pd.DataFrame, frame_ids: pd.Series) -> pa.ListArray:
    """Return one list of labels per frame. Needs labels and frames that are sorted by frame_id."""
    of_frames = labels[labels["frame_id"].isin(frame_ids)]
    counts = of_frames["frame_id"].value_counts().reindex(frame_ids, fill_value=0).to_numpy()
    offsets = pa.array(np.concatenate([[0], np.cumsum(counts)]), pa.int32())
    values = [pa.array(of_frames[field.name].to_numpy(), field.type, from_pandas=True) for field in _LABEL]
    return pa.ListArray.from_arrays(offsets, pa.StructArray.from_arrays(values, fields=list(_LABEL)))


class _Shards:
    """Writes the Parquet files of one split, each of at most about `shard_bytes` bytes."""

    def __init__(self, folder: Path, shard_bytes: int):
        self._folder, self._shard_bytes = folder, shard_bytes
        self._shard, self._size = 0, 0
        self._writer: pq.ParquetWriter | None = None
        folder.mkdir(parents=True)

    def write(self, rows: pa.Table) -> None:
        if self._writer is not None and self._size + rows.nbytes > self._shard_bytes:
            self.close()
        if self._writer is None:
            path = self._folder / f"{self._shard:05d}.parquet"
            self._writer = pq.ParquetWriter(path, rows.schema, compression="zstd")
            self._shard, self._size = self._shard + 1, 0
        self._writer.write_table(rows)
        self._size += rows.nbytes

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None
