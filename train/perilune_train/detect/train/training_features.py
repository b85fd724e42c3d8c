"""Fit the features of training frames, from which the novelty of other frames is computed (detect/novelty.py)."""

import numpy as np

from perilune_shared.dataset.manifest import Dataset
from perilune_train.data.frames import frame_table, load_images
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.novelty import TrainingFeatures, fit_training_features

MAX_FRAMES = 512
"""Largest number of training frames of the fit. More frames are thinned evenly."""


def training_features(detector: Detector, dataset: Dataset) -> TrainingFeatures | None:
    """Fit the features of a detector's training frames; returns None if there are too few frames or scenes.

    Raises UserError if a frame is damaged.
    """
    table = frame_table(dataset, "train")
    chosen = np.unique(np.linspace(0, len(table) - 1, min(MAX_FRAMES, len(table))).astype(int))
    rows = table.iloc[chosen].reset_index(drop=True)
    features = detector.features(load_images(dataset, rows, "train"))
    return fit_training_features(features, rows["scene_id"].to_numpy())
