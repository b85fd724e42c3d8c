"""Names that datasets and command lines use: kinds, splits, states of images; ids and paths of frames.

Without pandas and pyarrow, so that configurations and `--help` load without them.
"""

from typing import Literal, get_args

Kind = Literal["detect", "nav"]
"""Purpose of a dataset: crater detection or navigation."""
Split = Literal["train", "val", "test"]
"""Part of a dataset for training, validation or test."""
SplitUnit = Literal["scene", "trajectory", "frame"]
"""Rows that belong to one split as a whole."""
ImageState = Literal["files", "packed", "absent", "planned"]
"""Where the frames are: under frames/, in shards/*.parquet, left out, or not rendered yet (then without labels)."""
ImageKind = Literal["png", "exr"]
"""The two files of a frame: the image of the sensor, and radiance with depth and crater index."""
ImageChoice = Literal["copy", "none", "plan"]
"""How frames are written: `copy`, `none` (left out), or `plan` (frames, craters, boulders and labels left out: scenes
and poses determine them)."""
ImageMode = Literal[ImageChoice, "link"]
"""Also `link`: hard links where the file system allows them, so that an edit of a frame changes both datasets."""
KINDS: tuple[Kind, ...] = get_args(Kind)
SPLITS: tuple[Split, ...] = get_args(Split)
IMAGE_KINDS: tuple[ImageKind, ...] = get_args(ImageKind)


def frame_path(frame_id: str, kind: ImageKind) -> str:
    """Return the path of a frame's file relative to the dataset, as written by this version; readers use the manifest.

    The columns png_path and exr_path of other datasets may contain other paths.
    """
    return f"frames/{frame_id}.{kind}"


def frame_id_of(scene_id: str, trajectory_id: str, frame_index: int) -> str:
    """Return the key of a frame."""
    return f"{scene_id}/{trajectory_id}/{frame_index:06d}"
