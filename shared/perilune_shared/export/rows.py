"""Read the frames and labels of a dataset scene by scene, for exports and dataset cards.

Use:

    for scene in scenes_of(open_dataset("data/small/detect"), split="test"):
        print(scene.scene_id, len(scene.frames), len(scene.labels))
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import SPLITS
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import Selection

Choice = Callable[[Dataset, str, pa.Table], NDArray[np.bool_]]
"""Function that selects labels: takes the dataset, a scene_id and the scene's labels (N rows, all columns); returns
bool (N,)."""
LABEL_MEASURES = ("visible_fraction", "sunlit_fraction", "contrast")
"""Columns by which users select labels; an export to COCO includes them if the dataset has them."""


def by_selection(selection: Selection) -> Choice:
    """Return a function that selects labels by the thresholds of a selection."""

    def choose(dataset: Dataset, scene_id: str, labels: pa.Table) -> NDArray[np.bool_]:
        craters = dataset.table("craters", ["crater_id", "depth_m", "diameter_m"], scene_id=scene_id).to_pandas()
        craters = craters.drop_duplicates("crater_id")
        return selected(labels.to_pandas().merge(craters, on="crater_id", how="left"), selection)

    return choose


@dataclass(frozen=True, slots=True)
class SceneRows:
    """Frames and labels of one scene, limited to the requested splits."""

    scene_id: str
    """Id of the scene."""
    frames: pd.DataFrame
    """Rows of the table `frames`, sorted by frame_id, with the added column `image_id`."""
    labels: pd.DataFrame
    """Rows of the table `labels`, sorted by frame_id and crater_id, with the added columns `label_id` and `chosen`."""


def scenes_of(
    dataset: Dataset, split: str | None = None, choose: Choice | None = None, *, with_labels: bool = True
) -> Iterator[SceneRows]:
    """Yield the scenes of a dataset in order; only one scene is in memory at a time.

    `image_id` and `label_id` number the frames and labels of the whole dataset from 1, in order, so they do not depend
    on `split` and `choose`. Raises UserError if no frame belongs to the split, or a frame has an unknown split.
    """
    n_frames = n_labels = n_yielded = 0
    for scene_id in dataset.scene_ids():
        frames = dataset.table("frames", scene_id=scene_id).to_pandas()
        frames = frames.sort_values("frame_id", kind="stable", ignore_index=True)
        unknown = sorted(set(frames["split"]) - set(SPLITS))
        if unknown:
            # Split names become file names, and datasets are untrusted.
            raise UserError(dataset.store, "split", unknown[0], "one of " + ", ".join(SPLITS))
        frames["image_id"] = np.arange(len(frames)) + n_frames + 1
        n_frames += len(frames)
        rows = dataset.table("labels", scene_id=scene_id) if with_labels else TABLES["labels"].empty_table()
        chosen = np.ones(len(rows), bool) if choose is None else choose(dataset, scene_id, rows)
        labels = rows.to_pandas().assign(chosen=chosen)
        labels = labels.sort_values(["frame_id", "crater_id"], kind="stable", ignore_index=True)
        labels["label_id"] = np.arange(len(labels)) + n_labels + 1
        n_labels += len(labels)
        if split is not None:
            frames = frames[frames["split"] == split].reset_index(drop=True)
        labels = labels[labels["frame_id"].isin(frames["frame_id"])].reset_index(drop=True)
        n_yielded += len(frames)
        if len(frames):
            yield SceneRows(scene_id, frames, labels)
    if not n_yielded:
        raise UserError(
            dataset.store, "frames", "none" if split is None else f"none of split {split}", "at least one frame"
        )


def count_scenes(dataset: Dataset, split: str | None = None) -> int:
    """Return the number of scenes that `scenes_of` yields, as the total of a progress bar."""
    return len(dataset.scene_ids()) if split is None else len(set(_scene_of_each_frame(dataset, split)))


def count_frames(dataset: Dataset, split: str | None = None) -> int:
    """Return the number of frames that `scenes_of` yields, as the total of a progress bar."""
    return dataset.info.counts.frames if split is None else len(_scene_of_each_frame(dataset, split))


def _scene_of_each_frame(dataset: Dataset, split: str) -> list[str]:
    if split not in SPLITS:
        raise UserError(dataset.store, "split", split, "one of " + ", ".join(SPLITS))
    return dataset.table("frames", ["scene_id"], split=split)["scene_id"].to_pylist()


def clipped_boxes(labels: pd.DataFrame, frames: pd.DataFrame) -> NDArray[np.float64]:
    """Return the boxes of N labels, clipped to their frames: x0, y0, x1, y1 (N, 4), pixels."""
    size = frame_sizes(labels, frames)
    boxes = labels[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy(np.float64)
    return np.clip(boxes, 0.0, np.hstack([size, size]))


def frame_sizes(labels: pd.DataFrame, frames: pd.DataFrame) -> NDArray[np.float64]:
    """Return width and height of the frame of each of N labels (N, 2), pixels."""
    by_id = frames.set_index("frame_id")[["width_px", "height_px"]]
    return by_id.loc[labels["frame_id"]].to_numpy(np.float64).reshape(-1, 2)
