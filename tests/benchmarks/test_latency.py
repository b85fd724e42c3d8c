"""The profile of the detector's time by groups of operations."""

import numpy as np
import pytest
import torch

from benchmarks.train import latency
from perilune_train.detect.deploy.files import FlightDetector, write_onnx
from perilune_train.models.yolo import YOLOv3


@pytest.mark.parametrize("attention", ["none", "cbam_identity"])
def test_attention_takes_time_only_where_there_is_any(attention, tmp_path):
    network = YOLOv3(torch.full((3, 3, 2), 12.0), 1, 0.125, attention, (8, 16, 32)).eval()
    write_onnx(FlightDetector(network, 64), tmp_path / "network.onnx", {}, 1, 64)
    found = latency.profile(tmp_path / "network.onnx", 1, 1, 3, 64)
    assert found["median_s"] > 0 and found["convolution_s"] > 0 and found["other_s"] > 0
    assert (found["attention_s"] > 0) == (attention != "none")
    total = sum(found[f"{group}_s"] for group in latency.GROUPS)
    assert np.isclose(sum(found["largest_s"].values()), total, rtol=0.5)


def test_a_picture_of_the_groups(tmp_path):
    row = {"width": 1.0, "attention": "none", "strides": (8, 16, 32), "threads": 1, "limit_s": 0.01}
    latency.draw([{**row, **{f"{group}_s": 0.01 for group in latency.GROUPS}}], tmp_path / "latency.png")
    assert (tmp_path / "latency.png").stat().st_size > 5000
