"""The overview of a dataset: one picture of frames and their labels."""

import cv2
import numpy as np

from perilune_render.labels.drawing import draw_labels, enlarge, sheet_png
from perilune_render.labels.frame_labels import Labels
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import SELECTIONS

_SHEET_FRAMES = 12


def overview_png(dataset: Dataset) -> bytes:
    """Frames from the whole dataset, each also with its labels, visible ones in green."""
    frames = dataset.table("frames", ["frame_id", "scene_id", "trajectory_id", "png_path"]).to_pandas()
    chosen = frames.iloc[np.unique(np.linspace(0, len(frames) - 1, _SHEET_FRAMES).astype(int))]
    pictures = []
    for frame in chosen.itertuples():
        image = cv2.imdecode(np.frombuffer(dataset.store.read(frame.png_path), np.uint8), cv2.IMREAD_GRAYSCALE)
        labels = dataset.table("labels", scene_id=frame.scene_id, trajectory_id=frame.trajectory_id).to_pandas()
        craters = dataset.table("craters", ["crater_id", "depth_m", "diameter_m"], scene_id=frame.scene_id).to_pandas()
        own = labels[labels["frame_id"] == frame.frame_id].merge(craters, on="crater_id")
        drawn = draw_labels(image, Labels.from_table(own), selected(own, SELECTIONS["visible"]))
        pictures += [enlarge(image, 2), drawn]
    return sheet_png(pictures, 6)
