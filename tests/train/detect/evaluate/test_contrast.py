"""The benchmark that holds contrast beside what a detector found."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks.train import contrast
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS


def test_auc_by_hand():
    found = np.array([True, False, True, False])
    assert contrast.auc(np.array([3.0, 1.0, 2.0, 0.0]), found) == 1
    assert contrast.auc(np.array([0.0, 1.0, 2.0, 3.0]), found) == 0.25
    assert contrast.auc(np.ones(4), found) == 0.5
    assert contrast.auc(np.ones(2), found[::2]) is None


def test_a_detector_that_finds_what_shows(dataset_detect, tmp_path):
    """Detections that are the labels of contrast 20 of the larger craters, and some far too weak ones."""
    dataset = open_dataset(dataset_detect)
    box = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]
    labels = read_labels(dataset, box, "test")
    chosen = labels[selected(labels, SELECTIONS["visible"])]
    large = chosen["radius_px"] > 3
    table = {
        name: chosen[column].to_numpy() for name, column in zip(("x0_px", "y0_px", "x1_px", "y1_px"), box, strict=True)
    }
    table |= {"frame_id": chosen["frame_id"].tolist(), "score": np.where(large, 0.9, 0.2)}
    pq.write_table(pa.table(table), tmp_path / "detections.parquet")
    (tmp_path / "metrics.json").write_text(json.dumps({"test/threshold": 0.5}))
    frame = chosen["frame_id"].iloc[0]
    contrast.main(dataset_detect, tmp_path, frame, tmp_path / "out")
    result = json.loads((tmp_path / "out/contrast.json").read_text())
    every = result["auc"]["2-50 px"]
    assert every["labels"] == len(chosen) and every["found"] == pytest.approx(large.mean(), abs=0.02)
    assert every["radius_px"] > 0.98 and every["contrast"] == 0.5
    assert result["auc"]["2-3 px"]["found"] < 0.1 and result["auc"]["5-10 px"]["found"] == 1
    assert [row["labels"] for row in result["found_by_contrast"]][-1] == len(chosen)
    assert result["metrics"]["visible"]["precision"] > 0.98
    assert result["metrics"]["paper"]["labels"] > result["metrics"]["visible"]["labels"]
    assert (tmp_path / "out/contrast.jpg").stat().st_size > 5000
