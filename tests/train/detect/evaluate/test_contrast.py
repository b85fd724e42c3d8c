"""The benchmark that holds contrast beside what a detector found."""

import numpy as np
import pytest

from benchmarks.train import contrast
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.detect.evaluate.matching import Detections


def test_auc_by_hand():
    found = np.array([True, False, True, False])
    assert contrast.auc(np.array([3.0, 1.0, 2.0, 0.0]), found) == 1
    assert contrast.auc(np.array([0.0, 1.0, 2.0, 3.0]), found) == 0.25
    assert contrast.auc(np.ones(4), found) == 0.5
    assert contrast.auc(np.ones(2), found[::2]) is None


def test_a_detector_that_finds_what_shows(dataset_detect, tmp_path):
    """Detections that are the labels of the larger craters, and some far too weak ones."""
    dataset = open_dataset(dataset_detect)
    box = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
    labels = read_labels(dataset, box, "test")
    chosen = labels[selected(labels, SELECTIONS["visible"].model_copy(update={"min_contrast": None}))]
    large = chosen["radius_px"] > 3
    table = chosen.assign(score=np.where(large, 0.9, 0.2))
    found = {
        str(frame_id): Detections(own[box].to_numpy(), own["score"].to_numpy())
        for frame_id, own in table.groupby("frame_id")
    }
    result = contrast.measure(dataset, found, 0.5, "test") | {"metrics": contrast.evaluate(dataset, found, 0.5, "test")}
    contrast.draw(dataset, chosen["frame_id"].iloc[0], tmp_path / "contrast.jpg")
    every = result["auc"]["2-50 px"]
    assert every["labels"] == len(chosen) and every["found"] == pytest.approx(large.mean(), abs=0.02)
    assert every["radius_px"] > 0.98
    assert result["auc"]["2-3 px"]["found"] < 0.1 and result["auc"]["5-10 px"]["found"] == 1
    assert sum(row["labels"] for row in result["found_by_contrast"]) == len(chosen)
    assert result["metrics"]["visible"]["precision"] > 0.98
    assert result["metrics"]["paper"]["labels"] > result["metrics"]["visible"]["labels"]
    assert (tmp_path / "contrast.jpg").stat().st_size > 5000
