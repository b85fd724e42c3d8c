"""The score threshold that a run chooses."""

import numpy as np
import pytest
from tests.helpers.stored_run import settings_of, store_run

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.train import threshold as thresholds
from perilune_train.detect.train.threshold import threshold_on_validation, varied_split


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return store_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def split(few, run):
    return load_split(open_dataset(few), "val", settings_of(run).labels)


def truth(split, score, false_score):
    """A detector that finds every label, with one false positive in each frame."""
    found = []
    for labels in split.labels:
        boxes = np.vstack([labels.boxes[labels.selected], [[0.0, 0.0, 5.0, 5.0]]])
        scores = np.r_[np.full(len(boxes) - 1, score), false_score]
        found.append(Detections(boxes, scores))
    return found


def test_varied_frames_differ_in_pixels_only(split):
    varied, again = varied_split(split, 3), varied_split(split, 3)
    assert varied.labels is split.labels and varied.frames.table.equals(split.frames.table)
    assert np.array_equal(varied.frames.images, again.frames.images)
    assert not np.array_equal(varied.frames.images, varied_split(split, 4).frames.images)
    for own, other in zip(split.frames.images, varied.frames.images, strict=True):
        assert own.shape == other.shape and not np.array_equal(own, other)
        assert np.corrcoef(own.ravel(), other.ravel())[0, 1] > 0.6


def test_the_threshold_of_both_kinds_of_frames(run, split, monkeypatch):
    """Scores of 0.6 on frames as they are and 0.3 on varied ones; false positives below 0.2."""
    plain = truth(split, 0.6, 0.1)
    threshold, chosen_on = threshold_on_validation(
        open_detector(run / "checkpoints/best.ckpt", settings_of(run)), split, plain
    )
    assert 0.1 < threshold <= 0.6 and chosen_on.endswith("on val")
    asked = []

    def weaker(detector, given, name):
        asked.append(given)
        return truth(split, 0.3, 0.2), 1.0

    monkeypatch.setattr(thresholds, "detect_split", weaker)
    config = settings_of(run, "detect.evaluation.varied_frames=true")
    threshold, chosen_on = threshold_on_validation(open_detector(run / "checkpoints/best.ckpt", config), split, plain)
    assert 0.2 < threshold <= 0.3 and chosen_on.endswith("on val and varied val")
    assert len(asked) == 1 and not np.array_equal(asked[0].frames.images, split.frames.images)
