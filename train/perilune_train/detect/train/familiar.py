"""Fit the features of training frames, from which the novelty of other frames is computed (detect/novelty.py)."""

import numpy as np
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_train.data.frames import frame_table, load_images
from perilune_train.detect.data.augment import augment
from perilune_train.detect.inference.detector import Detector
from perilune_train.detect.novelty import TrainingFeatures, fit_training_features

MAX_FRAMES = 512
"""Largest number of training frames of the fit; more frames are evenly thinned."""
_STREAM = 8


def training_features(detector: Detector, dataset: Dataset) -> TrainingFeatures | None:
    """Fit the features of a detector's training frames, each as it is and once as augmented in training.

    Returns None if there are too few frames. Raises UserError if a frame is damaged.
    """
    table = frame_table(dataset, "train")
    chosen = np.unique(np.linspace(0, len(table) - 1, min(MAX_FRAMES, len(table))).astype(int))
    rows = table.iloc[chosen].reset_index(drop=True)
    images = load_images(dataset, rows, "train")
    plain = detector.features(images)
    return fit_training_features(plain, detector.features(augmented(detector, images)), rows["scene_id"].to_numpy())


def augmented(detector: Detector, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The frames (N, height, width) once more, augmented at random as in the detector's training."""
    changed, none = np.empty_like(images), np.zeros((0, 5))
    for number, image in enumerate(images):
        rng = np.random.default_rng([detector.config.seed, _STREAM, number])
        pixels, _, _ = augment(image, none, np.zeros(0, bool), (1.0, 2.0), detector.config.augment, rng)
        changed[number] = np.clip(np.rint(pixels), 0, 255)
    return changed
