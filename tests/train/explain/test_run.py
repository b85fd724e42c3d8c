import json

import cv2
import numpy as np
import pandas as pd
import pytest
import torch

from perilune_shared.errors import UserError
from perilune_shared.manifest import open_dataset
from perilune_train.data.frames import load_frames
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.masks import detector_masks, navigator_masks
from perilune_train.explain.run import explain_run
from perilune_train.models.navigator import StackNavigator
from perilune_train.models.yolo import YOLOv3
from perilune_train.runs import save_weights

_BLOCKS = [f"B_{i + 1}{j + 1}" for i, count in enumerate((1, 2, 8, 8, 4)) for j in range(count)]
_DETECTOR = {"in_channels": 1, "width": 0.125, "attention": "cbam", "strides": [4, 8, 16]}
_STACK = {
    "fusion": "stack",
    "size_px": 64,
    "in_channels": 1,
    "width": 0.125,
    "attention": "cbam",
    "hidden": 8,
    "focal_over_width": 1.4,
    "scales": {"mean_m": [0.0] * 3, "spread_m": [1.0] * 3, "rotation_rad": 0.01},
}


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Untrained networks: their masks are as real as trained ones."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("checkpoints")
    save_weights(folder / "detector.ckpt", _DETECTOR, YOLOv3(None, **_DETECTOR))
    save_weights(folder / "stack.ckpt", _STACK, StackNavigator(1, 0.125, "cbam", 8))
    return folder / "detector.ckpt", folder / "stack.ckpt"


def _explain(checkpoints, dataset_detect, dataset_nav, folder):
    return explain_run(
        ExplainConfig(n_frames=3, n_pairs=3, n_drawn=2, device="cpu"),
        dataset_detect,
        dataset_nav,
        *checkpoints,
        folder,
        "t",
    )


def test_a_run_correlates_every_block(checkpoints, dataset_detect, dataset_nav, tmp_path):
    run = _explain(checkpoints, dataset_detect, dataset_nav, tmp_path)
    table = pd.read_parquet(run.root / "correlations.parquet")
    for measure, count in (("pcc1", 3), ("pcc2", 6), ("pcc3", 3), ("pcc4", 3)):
        own = table[table["measure"] == measure]
        assert list(own["block"]) == _BLOCKS
        assert (own["count"] == count).all()
        assert own["value"].abs().max() <= 1 + 1e-9
    metrics = json.loads(run.metrics.read_text())
    first = table.query("measure == 'pcc1' and block == 'B_11'")["value"].iloc[0]
    assert metrics["pcc1/B_11"] == pytest.approx(first)
    # Any convolution of a picture follows its craters or shuns them, but does not ignore them.
    assert abs(first) > 0.02
    for name in ("masks_detect.png", "masks_navigate.png", "pcc_detect.png", "pcc_navigate.png"):
        assert cv2.imread(str(run.root / name)).std() > 5, name


def test_masks_are_those_of_the_network_at_the_frames_size(dataset_detect, tmp_path):
    torch.manual_seed(1)
    detector = YOLOv3(None, **_DETECTOR).eval()
    images = load_frames(open_dataset(dataset_detect), "test").images[:2]
    masks = detector_masks(detector, images, tmp_path)
    assert list(masks) == _BLOCKS
    assert all(mask.shape == (2, 96, 96) and mask.min() >= 0 and mask.max() <= 1 for mask in masks.values())
    pixels = (images[1] - images[1].mean()) / images[1].std()
    with torch.no_grad():
        own = detector.backbone.attention_masks(torch.from_numpy(pixels).float()[None, None])["B_21"][0, 0]
    np.testing.assert_allclose(masks["B_21"][1], cv2.resize(own.numpy(), (96, 96)), atol=1e-4)


def test_a_stacked_mask_holds_both_halves(tmp_path):
    torch.manual_seed(1)
    navigator = StackNavigator(1, 0.125, "cbam", 8).eval()
    frame = np.random.default_rng(0).normal(size=(1, 64, 64)).astype(np.float32)
    flat = np.zeros_like(frame)
    mask = navigator_masks(navigator, frame, flat, (128, 128), tmp_path)["B_11"][0]
    assert mask.shape == (256, 128)
    # The earlier frame is above: noise there, nothing below.
    assert mask[20:108].std() > 5 * mask[148:236].std()


def test_what_cannot_be_explained(checkpoints, dataset_detect, dataset_nav, tmp_path):
    detector, stack = checkpoints
    plain = _DETECTOR | {"attention": "none"}
    save_weights(tmp_path / "plain.ckpt", plain, YOLOv3(None, **plain))
    with pytest.raises(UserError, match="attention: got none"):
        _explain((tmp_path / "plain.ckpt", stack), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="no such file"):
        _explain((tmp_path / "missing.ckpt", stack), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="fusion"):
        _explain((detector, detector), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="kind: got nav"):
        _explain((detector, stack), dataset_nav, dataset_nav, tmp_path)
