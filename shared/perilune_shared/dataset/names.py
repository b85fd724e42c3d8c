"""Names that datasets and command lines share: kinds, splits, image states, ids and paths.

This module imports neither pandas nor pyarrow, so that configurations and `--help` load without them.
"""

from typing import Literal, get_args

Kind = Literal["detect", "nav"]
"""Purpose of a dataset: crater detection or navigation."""
Split = Literal["train", "val", "test"]
"""Part of a dataset for training, validation or test."""
SplitUnit = Literal["scene", "trajectory", "frame"]
"""Unit of a split: all rows of a unit belong to one split."""
ImageState = Literal["files", "packed", "absent", "planned"]
"""Where the frames are: under frames/, in shards/*.parquet, omitted, or not rendered yet (then without labels)."""
ImageKind = Literal["png", "exr", "lidar"]
"""The files of a frame: image of the sensor; radiance with depth and crater index; ranges of the flash lidar."""
SceneFileKind = Literal["hazard"]
"""The files of a scene: its hazard map."""
ImageChoice = Literal["copy", "none", "plan"]
"""How frames are written: `copy`, `none` (omitted), or `plan` (frames, craters, boulders and labels omitted: scenes
and poses determine them)."""
ImageMode = Literal[ImageChoice, "link"]
"""ImageChoice, or `link`: hard links where the file system allows them. Editing a frame then changes both datasets."""
WHOLE_TABLE = "all"
"""Name of the part that contains all rows of its table, or the first rows if the table has several such parts."""
_ID = "[A-Za-z0-9][A-Za-z0-9_-]{0,63}"
ID_PATTERN = f"^{_ID}$"
"""Pattern of scene_id and trajectory_id, which become file names."""
FRAME_ID_PATTERN = f"^{_ID}/{_ID}/[0-9]{{6}}$"
CAMERA_PATTERN = "^[a-z][a-z0-9_]{0,30}$"
"""Pattern of the names of several cameras on one body."""
PART_PATTERN = rf"^{_ID}(\.{_ID})?$"
KINDS: tuple[Kind, ...] = get_args(Kind)
SPLITS: tuple[Split, ...] = get_args(Split)
IMAGE_KINDS: tuple[ImageKind, ...] = get_args(ImageKind)
SUFFIXES: dict[ImageKind | SceneFileKind, str] = {
    "png": ".png",
    "exr": ".exr",
    "lidar": ".lidar.exr",
    "hazard": ".tif",
}
"""How the name of each file ends."""
SCENE_FILE_KINDS: tuple[SceneFileKind, ...] = get_args(SceneFileKind)


def frame_path(frame_id: str, kind: ImageKind) -> str:
    """Return the path of a frame's file relative to the dataset, as written by this version.

    Readers use the manifest. The columns png_path, exr_path and lidar_path of other datasets may contain other paths.
    """
    return f"frames/{frame_id}{SUFFIXES[kind]}"


def scene_file_path(scene_id: str, kind: SceneFileKind) -> str:
    """Return the path of a scene's file relative to the dataset, as written by this version."""
    return f"{kind}/{scene_id}{SUFFIXES[kind]}"


def stem_of(path: str) -> str:
    """Return the name of a part, without folders and suffix."""
    return path.rpartition("/")[2].removesuffix(".parquet")


def is_whole(stem: str) -> bool:
    """Whether a part of this name may contain rows of any scene."""
    return stem.partition(".")[0] == WHOLE_TABLE


def frame_id_of(scene_id: str, trajectory_id: str, frame_index: int) -> str:
    """Return the key of a frame."""
    return f"{scene_id}/{trajectory_id}/{frame_index:06d}"


def trajectory_of_camera(camera: str, trajectory_id: str) -> str:
    """Return the trajectory_id of the frames of one of several cameras along a trajectory of the body."""
    return f"{camera}-{trajectory_id}"


def trajectory_of_body(camera: str, trajectory_id: str) -> str:
    """Return the name of the body's trajectory, given the camera and the trajectory_id of its frames.

    Frames of one instant share scene_id, this name and frame_index.
    """
    return trajectory_id.removeprefix(f"{camera}-")
