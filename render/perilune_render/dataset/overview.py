"""The overview of a dataset: one picture of frames and their labels."""

import cv2
import numpy as np

from perilune_render.labels.drawing import draw_labels, enlarge, padded, sheet_png
from perilune_render.labels.frame_labels import Labels
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import SELECTIONS

_SHEET_FRAMES, _FRAMES_PER_CAMERA, _COLUMNS = 12, 3, 6


def overview_png(dataset: Dataset) -> bytes:
    """Frames from the whole dataset, each also with its labels, visible ones in green.

    Several cameras have a row each.
    """
    frames = dataset.table("frames", ["frame_id", "scene_id", "trajectory_id", "png_path", "camera"]).to_pandas()
    if dataset.info.cameras is None:
        chosen = [_spread(len(frames), _SHEET_FRAMES)]
    else:
        rows = [np.flatnonzero(frames["camera"] == name) for name in dataset.info.cameras]
        chosen = [own[_spread(len(own), _FRAMES_PER_CAMERA)] for own in rows]
    pictures = []
    for frame in frames.iloc[np.concatenate(chosen)].itertuples():
        image = cv2.imdecode(np.frombuffer(dataset.store.read(frame.png_path), np.uint8), cv2.IMREAD_GRAYSCALE)
        labels = dataset.table("labels", scene_id=frame.scene_id, trajectory_id=frame.trajectory_id).to_pandas()
        craters = dataset.table("craters", ["crater_id", "depth_m", "diameter_m"], scene_id=frame.scene_id).to_pandas()
        own = labels[labels["frame_id"] == frame.frame_id].merge(craters, on="crater_id")
        drawn = draw_labels(image, Labels.from_table(own), selected(own, SELECTIONS["visible"]))
        pictures += [enlarge(image, 2), drawn]
    if dataset.info.cameras is not None:
        pictures = padded(pictures, [2 * len(own) for own in chosen], _COLUMNS)
    return sheet_png(pictures, _COLUMNS)


def _spread(n: int, n_chosen: int) -> np.ndarray:
    """At most `n_chosen` indices, evenly spread over n."""
    return np.unique(np.linspace(0, n - 1, n_chosen).astype(int)) if n else np.empty(0, int)
