"""What all exports share: a dataset's rows scene by scene, and an output that appears whole or not at all.

Use::

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
from perilune_shared.dataset.schema import SPLITS, TABLES
from perilune_shared.dataset.selection import Selection, selected
from perilune_shared.errors import UserError

Choice = Callable[[Dataset, str, pa.Table], NDArray[np.bool_]]
"""Which labels to take: from the dataset, a scene_id and that scene's labels (N rows, every column), bool (N,)."""
LABEL_MEASURES = ("visible_fraction", "sunlit_fraction", "contrast")
"""Columns of labels by which users choose; an export carries those that the dataset has."""


def by_selection(selection: Selection) -> Choice:
    """The choice of the labels that a selection takes."""

    def choose(dataset: Dataset, scene_id: str, labels: pa.Table) -> NDArray[np.bool_]:
        craters = dataset.table("craters", ["crater_id", "depth_m", "diameter_m"], scene_id=scene_id).to_pandas()
        craters = craters.drop_duplicates("crater_id")
        return selected(labels.to_pandas().merge(craters, on="crater_id", how="left"), selection)

    return choose


@dataclass(frozen=True, slots=True)
class SceneRows:
    """Frames and labels of one scene, of the splits asked for."""

    scene_id: str
    """The terrain."""
    frames: pd.DataFrame
    """Rows of the table frames, by frame_id, with `image_id`."""
    labels: pd.DataFrame
    """Rows of the table labels, by frame_id and crater_id, with `label_id` and `chosen`."""


def scenes_of(
    dataset: Dataset, split: str | None = None, choose: Choice | None = None, *, with_labels: bool = True
) -> Iterator[SceneRows]:
    """Scene by scene, in order. Memory holds one scene at a time.

    `image_id` and `label_id` count the frames and labels of the whole dataset from 1, in order, so that they are the
    same whatever split and choice are asked for. Raises UserError where no frame is of the split, or
    one is of an unknown split.
    """
    n_frames = n_labels = n_given = 0
    for scene_id in dataset.scene_ids():
        frames = dataset.table("frames", scene_id=scene_id).to_pandas()
        frames = frames.sort_values("frame_id", kind="stable", ignore_index=True)
        odd = sorted(set(frames["split"]) - set(SPLITS))
        if odd:
            # Splits name files, and a dataset may come from anybody.
            raise UserError(dataset.root, "split", odd[0], "one of " + ", ".join(SPLITS))
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
        n_given += len(frames)
        if len(frames):
            yield SceneRows(scene_id, frames, labels)
    if not n_given:
        raise UserError(dataset.root, "frames", "none" if split is None else f"none of split {split}", "some frames")


def clipped_boxes(labels: pd.DataFrame, frames: pd.DataFrame) -> NDArray[np.float64]:
    """Boxes (N, 4) of labels as x0, y0, x1, y1, pixels, cut at the edges of their frames."""
    size = sizes(labels, frames)
    boxes = labels[["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]].to_numpy(np.float64)
    return np.clip(boxes, 0.0, np.hstack([size, size]))


def sizes(labels: pd.DataFrame, frames: pd.DataFrame) -> NDArray[np.float64]:
    """Width and height (N, 2) of the frame of each label, pixels."""
    by_id = frames.set_index("frame_id")[["width_px", "height_px"]]
    return by_id.loc[labels["frame_id"]].to_numpy(np.float64).reshape(-1, 2)
