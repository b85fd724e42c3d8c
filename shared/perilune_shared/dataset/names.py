"""Names that datasets and command lines share: kinds, splits, image states, ids and paths.

This module imports neither pandas nor pyarrow, so that configurations and `--help` load without them.
"""

from typing import Literal, get_args

Kind = Literal["detect", "nav"]
"""Purpose of a dataset: crater detection or navigation."""
Split = Literal["train", "val", "test"]
"""Part of a dataset for training, validation or test."""
SplitUnit = Literal["scene", "trajectory", "frame"]
"""What a split never divides: all rows of a scene, trajectory or frame belong to one split."""
ImageState = Literal["files", "packed", "absent", "planned"]
"""Where the frames are: under frames/, packed in shards/*.parquet, omitted, or not rendered yet.

Planned frames have no labels yet."""
ImageKind = Literal["png", "exr", "lidar"]
"""Kinds of files of a frame.

`png` is the image of the sensor, `exr` has radiance, depth and crater index, `lidar` has ranges of the flash lidar."""
SceneFileKind = Literal["hazard"]
"""Kinds of files of a scene: the hazard map."""
ImageChoice = Literal["copy", "none", "plan"]
"""What a new dataset contains: frames (`copy`), no frames (`none`), or scenes and poses (`plan`).

A plan omits craters, boulders and labels too, since scenes and poses determine them."""
ImageMode = Literal[ImageChoice, "link"]
"""ImageChoice, or `link`: hard-link frames where possible.

Editing a linked frame changes both datasets."""
WHOLE_TABLE = "all"
"""Name of the part with all rows of its table, or with the first rows if they fill several parts."""
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
"""End of the file name, by kind."""
SCENE_FILE_KINDS: tuple[SceneFileKind, ...] = get_args(SceneFileKind)


def frame_path(frame_id: str, kind: ImageKind) -> str:
    """Return the path, relative to the dataset, at which this version writes a file of a frame.

    Readers use the columns png_path, exr_path and lidar_path instead: other datasets may have other paths.
    """
    return f"frames/{frame_id}{SUFFIXES[kind]}"


def scene_file_path(scene_id: str, kind: SceneFileKind) -> str:
    """Return the path, relative to the dataset, at which this version writes a file of a scene."""
    return f"{kind}/{scene_id}{SUFFIXES[kind]}"


def stem_of(path: str) -> str:
    """Return the name of a part, without folders and suffix."""
    return path.rpartition("/")[2].removesuffix(".parquet")


def is_whole(stem: str) -> bool:
    """Whether a part with the name `stem` may contain rows of any scene."""
    return stem.partition(".")[0] == WHOLE_TABLE


def frame_id_of(scene_id: str, trajectory_id: str, frame_index: int) -> str:
    """Return the key of a frame."""
    return f"{scene_id}/{trajectory_id}/{frame_index:06d}"


def trajectory_of_camera(camera: str, trajectory_id: str) -> str:
    """Return the trajectory_id for the frames of one camera, if the lander has several cameras."""
    return f"{camera}-{trajectory_id}"


def trajectory_of_body(camera: str, trajectory_id: str) -> str:
    """Return the name of the lander's trajectory from a camera and the trajectory_id of its frames.

    Frames of several cameras at one instant have this name, scene_id and frame_index in common.
    """
    return trajectory_id.removeprefix(f"{camera}-")
