"""Read and write packed frames: PNGs in images/*.parquet."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import IMAGES
from perilune_shared.errors import UserError

MOST_IMAGES_WRITTEN = 1_000_000
"""Maximum number of frames of a shard; it gives 7,813 row groups, and readers accept 10,000."""
_IMAGES_PER_GROUP, _BYTES_PER_GROUP = 128, 2**28


def shards_of(root: Path) -> list[Path]:
    """Return the Parquet files of a dataset that contain packed frames."""
    return sorted(root.joinpath("images").glob("[A-Za-z0-9]*.parquet"))


def read_packed(root: Path, frame_ids: set[str]) -> Iterator[tuple[str, bytes]]:
    """Yield frame_id and PNG bytes of packed frames, in the order in which they are stored.

    Raises UserError if a frame is missing.
    """
    missing = set(frame_ids)
    for shard in shards_of(root):
        if not missing:
            return
        part = Part(shard, "images", IMAGES)
        for group in part.groups_within("frame_id", min(missing), max(missing) + "\x00"):
            keys = part.read(["frame_id"], [group])["frame_id"].to_pylist()
            if missing.isdisjoint(keys):
                continue
            images = part.read(["image"], [group])["image"]
            for frame_id, image in zip(keys, images, strict=True):
                if frame_id in missing:
                    missing.remove(frame_id)
                    yield frame_id, image["bytes"].as_py() or b""
    if missing:
        raise UserError(root / "images", "frame_id", f"no {min(missing)}", "every frame of the manifest")


def write_packed(
    root: Path, images: Iterable[tuple[str, str, bytes]], shard_bytes: int, most_images: int = MOST_IMAGES_WRITTEN
) -> None:
    """Write frames (frame_id, png_path, PNG bytes) into images/*.parquet, of up to about `shard_bytes` each."""
    root.joinpath("images").mkdir(parents=True, exist_ok=True)
    shard = _ShardWriter(root / "images", 0)
    try:
        for name, path, png in images:
            if shard.n_images and (shard.n_bytes + len(png) > shard_bytes or shard.n_images == most_images):
                shard.close()
                shard = _ShardWriter(root / "images", shard.number + 1)
            shard.add(name, path, png)
    finally:
        shard.close()


class _ShardWriter:
    """Writer of one shard; the file is created with the first row group."""

    def __init__(self, folder: Path, number: int):
        self.number, self.n_images, self.n_bytes = number, 0, 0
        self._path = folder / f"{number:05d}.parquet"
        self._buffer: list[dict] = []
        self._buffer_bytes = 0
        self._writer: pq.ParquetWriter | None = None

    def add(self, frame_id: str, path: str, png: bytes) -> None:
        """Add a frame; write a row group whenever it is full."""
        self._buffer.append({"frame_id": frame_id, "image": {"bytes": png, "path": path}})
        self.n_images += 1
        self.n_bytes += len(png)
        self._buffer_bytes += len(png)
        if len(self._buffer) == _IMAGES_PER_GROUP or self._buffer_bytes > _BYTES_PER_GROUP:
            self._flush()

    def close(self) -> None:
        """Write the last row group and close the file."""
        self._flush()
        if self._writer is not None:
            self._writer.close()

    def _flush(self) -> None:
        if not self._buffer:
            return
        if self._writer is None:
            # PNG is already compressed, and all frames differ.
            self._writer = pq.ParquetWriter(self._path, IMAGES, compression="none", use_dictionary=["frame_id"])
        self._writer.write_table(pa.Table.from_pylist(self._buffer, schema=IMAGES))
        self._buffer, self._buffer_bytes = [], 0
