"""Packed frames: shards/<split>-00000-of-00012.parquet, one row per frame: pose, image and labels."""

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.names import SPLITS
from perilune_shared.dataset.parts import Part, parquet_files
from perilune_shared.dataset.schema import SCHEMA_VERSION, TABLES
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

FOLDER = "shards"
_NAME = re.compile(rf"({'|'.join(SPLITS)})-([0-9]{{5}})-of-([0-9]{{5}})\.parquet")
_DTYPES = {
    pa.string(): "string",
    pa.int64(): "int64",
    pa.float32(): "float32",
    pa.float64(): "float64",
    pa.bool_(): "bool",
}
IMAGE = pa.field(
    "image",
    pa.struct([pa.field("bytes", pa.binary()), pa.field("path", pa.string())]),
    metadata={"unit": "", "meaning": "the PNG file's bytes, and the png_path of the frame"},
)
LABEL = pa.struct([field for field in TABLES["labels"] if field.name not in TABLES["frames"].names])
"""One label of a frame: the columns of `labels` that are not columns of `frames`."""


def features_of(columns: list[pa.Field]) -> bytes:
    """Return the Parquet metadata `huggingface`, which makes `datasets` decode the column `image`."""
    features = {field.name: {"_type": "Image"} if field.name == "image" else _feature(field.type) for field in columns}
    return json.dumps({"info": {"features": features}}).encode()


def _feature(kind: pa.DataType) -> dict[str, Any]:
    """Describe an Arrow type in the notation of the library `datasets`."""
    if pa.types.is_fixed_size_list(kind):
        return {"feature": _feature(kind.value_type), "length": kind.list_size, "_type": "List"}
    if pa.types.is_list(kind):
        return {"feature": {field.name: _feature(field.type) for field in kind.value_type}, "_type": "List"}
    return {"dtype": _DTYPES[kind], "_type": "Value"}


def _shard_schema() -> pa.Schema:
    labels = pa.list_(pa.field("element", LABEL, nullable=False))
    meaning = {"unit": "", "meaning": "the frame's labels: the columns of the table labels"}
    of_frames = [field for field in TABLES["frames"] if field.name != "camera"]
    columns = [*of_frames, IMAGE, pa.field("labels", labels, nullable=False, metadata=meaning)]
    about = {"perilune.table": FOLDER, "perilune.schema_version": SCHEMA_VERSION, "huggingface": features_of(columns)}
    return pa.schema(columns, metadata=about)


SHARDS = _shard_schema()
"""Schema of a shard: all columns of `frames` except `camera`, then the image and the labels."""


def shard_name(split: str, number: int, count: int) -> str:
    """Return the path of a shard, relative to the dataset."""
    return f"{FOLDER}/{split}-{number:05d}-of-{count:05d}.parquet"


def split_of(shard: str) -> str:
    """Return the split in the name of a shard."""
    return shard.rpartition("/")[2].partition("-")[0]


def shards_of(store: Store, split: str | None = None) -> list[str]:
    """Return the paths of all shards, or of the shards of one split, sorted by name."""
    paths = [path for path in parquet_files(store, FOLDER) if _NAME.fullmatch(path.rpartition("/")[2])]
    return [path for path in paths if split in (None, split_of(path))]


def open_shard(store: Store, path: str) -> Part:
    """Open a shard and check its footer. Raises UserError as `Part` does."""
    return Part(store, path, FOLDER, SHARDS)


def read_packed(store: Store, frame_ids: set[str], split: str | None = None) -> Iterator[tuple[str, bytes]]:
    """Yield frame_id and PNG bytes of the given packed frames, in the order of the shards.

    `split` limits the search to the shards of one split. Raises UserError if a frame is missing.
    """
    missing = set(frame_ids)
    for path in shards_of(store, split):
        if not missing:
            return
        shard = open_shard(store, path)
        for group in shard.groups_within("frame_id", min(missing), max(missing) + "\x00"):
            keys = shard.read(["frame_id"], [group])["frame_id"].to_pylist()
            if missing.isdisjoint(keys):
                continue
            images = shard.read(["image"], [group])["image"]
            for frame_id, image in zip(keys, images, strict=True):
                if frame_id in missing:
                    missing.remove(frame_id)
                    yield frame_id, image["bytes"].as_py() or b""
    if missing:
        raise UserError(store.at(FOLDER), "frame_id", f"no {min(missing)}", "every frame of the manifest")


def packed_rows(frames: pa.Table, labels: pa.Table, pngs: list[bytes | None]) -> pa.Table:
    """Return the N rows of a shard from N rows of `frames`, rows of `labels` and N contents of PNGs.

    Labels of other frames are omitted. The labels of a frame keep their order.
    """
    row_of = pc.index_in(labels["frame_id"], frames["frame_id"].combine_chunks())
    frame_of = pc.fill_null(row_of, len(frames)).to_numpy()
    counts = np.bincount(frame_of, minlength=len(frames) + 1)[: len(frames)]
    of_frames = np.argsort(frame_of, kind="stable")[: counts.sum()]
    columns = [labels[field.name].combine_chunks().take(pa.array(of_frames)) for field in LABEL]
    offsets = pa.array(np.concatenate([[0], np.cumsum(counts)]), pa.int32())
    nested = pa.ListArray.from_arrays(offsets, pa.StructArray.from_arrays(columns, fields=list(LABEL)))
    images = [pa.array(pngs, pa.binary()), frames["png_path"].combine_chunks()]
    image = pa.StructArray.from_arrays(images, fields=list(IMAGE.type))
    rows = [frames[name] for name in SHARDS.names[:-2]]
    return pa.table([*rows, image, nested.cast(SHARDS.field("labels").type)], schema=SHARDS)
