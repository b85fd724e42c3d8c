"""A dataset's frames in memory: 8-bit grey pixels with their rows of the manifest."""

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.console.terminal import progress_bar
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.png import png_header
from perilune_shared.threads import usable_cores
from perilune_train.data.shares import ALONE, Share

_PORTION = 256
"""Number of compressed frames held in memory at a time."""
_ORDER = ["scene_id", "trajectory_id", "frame_index"]
_POSE = ["time_s", "position_m", "rotation_wxyz", "sun_direction"]
_FILE = ["png_path", "png_bytes"]


@dataclass(frozen=True)
class FrameStore:
    """Frames of one split or of a share of it, in the order scene, trajectory, frame index."""

    table: pd.DataFrame
    """Rows of `frame_table`, index 0..N-1."""
    images: NDArray[np.uint8]
    """Pixels (N, height, width), 8-bit grey."""

    def __len__(self) -> int:
        return len(self.images)


def decode(png: bytes, name: str, height_px: int, width_px: int, size_bytes: int | None = None) -> NDArray[np.uint8]:
    """Decode a PNG to a frame (height, width), 8-bit grey; a 16-bit PNG gives its upper eight bits.

    Raises UserError if the PNG does not have `size_bytes` bytes as in the manifest, is not grey, has another size in
    pixels (checked before decoding), or cannot be decoded.
    """
    # A decoder may fill the missing rows of a truncated file silently, so check the length.
    if size_bytes is not None and len(png) != size_bytes:
        expected = f"{size_bytes} bytes; see `perilune-manifest validate`, and render the damaged frames again"
        raise UserError(name, "png_bytes", f"{len(png)} bytes", expected)
    try:
        header = png_header(png)
    except ValueError as error:
        raise UserError(name, "frame", error, "a grey PNG") from None
    if (header.height_px, header.width_px) != (height_px, width_px):
        raise UserError(name, "size", f"{header.width_px} x {header.height_px}", f"{width_px} x {height_px} pixels")
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise UserError(name, "frame", "a file that cannot be decoded", "a grey PNG")
    return (image >> 8 if image.dtype == np.uint16 else image).astype(np.uint8, copy=False)


def frame_table(dataset: Dataset, split: str) -> pd.DataFrame:
    """Ids, times, poses and files of the frames of a split, sorted by scene, trajectory and frame index.

    Raises UserError if the split has no frames.
    """
    table = dataset.table("frames", ["frame_id", *_ORDER, *_POSE, *_FILE], split=split).to_pandas()
    if table.empty:
        raise UserError(dataset.store, "split", f"no {split} frames", "a dataset with frames in train, val and test")
    return table.sort_values(_ORDER, ignore_index=True)


def load_frames(dataset: Dataset, split: str, share: Share = ALONE, table: pd.DataFrame | None = None) -> FrameStore:
    """Load the frames of a split, or of a share of it; a frame of 256 x 256 px takes 64 kB.

    `table` is the `frame_table` of the split, if the caller has it. Raises UserError if the split is empty, if its
    frames do not fit into memory, or if a frame is invalid.
    """
    table = frame_table(dataset, split) if table is None else table
    rows = table.iloc[list(share.of(len(table)))].reset_index(drop=True)
    return FrameStore(rows, load_images(dataset, rows, split))


def load_images(dataset: Dataset, table: pd.DataFrame, split: str) -> NDArray[np.uint8]:
    """Load the pixels (N, height, width) of N rows of the `frame_table` of a split.

    Raises UserError if the frames do not fit into memory or if a frame is invalid.
    """
    camera = dataset.info.camera
    n_bytes = len(table) * camera.height_px * camera.width_px
    if n_bytes > os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"):
        got = f"{len(table)} frames of {camera.width_px} x {camera.height_px} pixels, {n_bytes / 2**30:.1f} GiB"
        raise UserError(dataset.store, "frames", got, f"{split} frames that fit into memory; see detect.stream")
    images = np.empty((len(table), camera.height_px, camera.width_px), np.uint8)
    index_of = {frame_id: index for index, frame_id in enumerate(table["frame_id"])}
    paths, sizes = table["png_path"].tolist(), table["png_bytes"].tolist()
    rows = pa.table({column: table[column].tolist() for column in ("frame_id", "png_path")})

    def unpack(frame: tuple[str, bytes]) -> None:
        i = index_of[frame[0]]
        images[i] = decode(frame[1], f"{dataset.store}/{paths[i]}", camera.height_px, camera.width_px, sizes[i])

    # OpenCV releases Python's global interpreter lock while it decodes.
    with progress_bar() as progress, ThreadPoolExecutor(min(usable_cores(), 16)) as threads:
        task = progress.add_task(f"load {split}", total=len(table), unit="frames", note="")
        for portion in _portions(dataset.pngs(rows, split), _PORTION):
            for _ in threads.map(unpack, portion):
                progress.advance(task)
    return images


def _portions(frames: Iterable[tuple[str, bytes]], size: int) -> Iterator[list[tuple[str, bytes]]]:
    rest = iter(frames)
    while portion := list(islice(rest, size)):
        yield portion


def normalised(images: NDArray) -> NDArray[np.float32]:
    """Subtract each image's mean and divide by its standard deviation or 1, whichever is larger.

    Images are (..., height, width). A constant image becomes zero. Normalising loses nothing: the exposure of a frame
    carries no information about craters or motion.
    """
    pixels = images.astype(np.float32)
    mean = pixels.mean(axis=(-2, -1), keepdims=True)
    deviation = pixels.std(axis=(-2, -1), keepdims=True)
    return (pixels - mean) / np.maximum(deviation, 1.0)
