import json

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record, uses_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.data.frames import load_frames
from perilune_train.detect.cli.evaluate import config_of_run
from perilune_train.detect.inference.detector import load_detector
from perilune_train.evaluation.provenance import training_provenance
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.masks import caption, detector_masks, draw_masks, navigator_masks
from perilune_train.explain.run import detect_frames, explain_run
from perilune_train.models.navigator import StackNavigator
from perilune_train.models.yolo import YOLOv3
from perilune_train.training.runs import save_weights

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


def _store(folder):
    """Untrained networks: their masks are as real as trained ones."""
    torch.manual_seed(0)
    save_weights(folder / "stack.ckpt", _STACK, StackNavigator(1, 0.125, "cbam", 8))
    return store_run(folder, "attention=cbam") / "checkpoints" / "best.ckpt", folder / "stack.ckpt"


@pytest.fixture(scope="module")
def checkpoints(dataset_detect, dataset_nav, tmp_path_factory):
    """A detector and a stack navigator with the records that training on the two datasets leaves."""
    stored = _store(tmp_path_factory.mktemp("checkpoints"))
    for path, dataset in zip(stored, (dataset_detect, dataset_nav), strict=True):
        store_record(path, training_provenance(open_dataset(dataset)).uses)
    return stored


def _explain(checkpoints, dataset_detect, dataset_nav, folder, n_drawn=2, **options):
    settings = ExplainConfig(n_frames=3, n_pairs=3, n_drawn=n_drawn, device="cpu")
    return explain_run(settings, dataset_detect, dataset_nav, *checkpoints, folder, "t", **options)


def _banded(path):
    """Whether a picture has the red band of a terrain mark."""
    blue, green, red = cv2.imread(str(path))[1, 1].astype(int)
    return red > 150 and max(blue, green) < 80


def test_a_run_correlates_every_block(checkpoints, dataset_detect, dataset_nav, tmp_path):
    run = _explain(checkpoints, dataset_detect, dataset_nav, tmp_path)
    table = pd.read_parquet(run.root / "correlations.parquet")
    for measure, count in (("pcc1_background", 3), ("pcc1_craterness", 3), ("pcc2", 6), ("pcc3", 3), ("pcc4", 3)):
        own = table[table["measure"] == measure]
        assert list(own["block"]) == _BLOCKS
        assert (own["count"] == count).all()
        assert own["value"].abs().max() <= 1 + 1e-9
    metrics = json.loads(run.metrics.read_text())
    # The sign: G is 1 on background.
    config = config_of_run(checkpoints[0].parent.parent, ())
    frames, truth, _ = detect_frames(ExplainConfig(n_frames=3), config, dataset_detect)
    masks = detector_masks(load_detector(checkpoints[0]), frames, tmp_path)["B_11"]
    own = np.mean([np.corrcoef(mask.ravel(), g.ravel())[0, 1] for mask, g in zip(masks, truth, strict=True)])
    assert metrics["pcc1_background/B_11"] == pytest.approx(own, abs=1e-5)
    assert metrics["pcc1_craterness/B_11"] == pytest.approx(-own, abs=1e-5)
    assert "weaker on craters" in metrics["pcc1_sign"] and metrics["labels/selection"] == "visible"
    both = table.query("measure == 'pcc4' and block == 'B_11'").iloc[0]
    assert metrics["pcc4_all_pixels/B_11"] == pytest.approx(both["value_all_pixels"]) != metrics["pcc4/B_11"]
    for name in ("masks_detect.png", "masks_navigate.png", "pcc_detect.png", "pcc_navigate.png"):
        assert cv2.imread(str(run.root / name)).std() > 5, name
        assert not _banded(run.root / name), name
    # The detection dataset splits by scene, the navigation dataset by trajectory.
    assert (metrics["detector/terrain/status"], metrics["detector/terrain/mark"]) == ("disjoint", "")
    assert (metrics["navigator/terrain/status"], metrics["navigator/terrain/mark"]) == ("by protocol", "")
    assert metrics["detector/dataset/protocol"] == "held-out scenes"
    assert metrics["navigator/dataset/protocol"].startswith("held-out descents, shared terrain")
    # The same again leaves it alone; other settings or another checkpoint are refused.
    before = {path: path.stat().st_mtime_ns for path in run.root.rglob("*")}
    _explain(checkpoints, dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match=r"explain.n_drawn: got 1, expected 2, as in the existing run; --overwrite"):
        _explain(checkpoints, dataset_detect, dataset_nav, tmp_path, n_drawn=1)
    with pytest.raises(UserError, match=r"inputs.json: detector: got SHA-256 .*--overwrite"):
        _explain((checkpoints[1], checkpoints[1]), dataset_detect, dataset_nav, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in run.root.rglob("*")} == before


def test_test_terrain_that_a_network_was_fitted_to_is_refused_or_marked(dataset_detect, dataset_nav, tmp_path):
    detector, stack = _store(tmp_path / "networks")
    store_record(detector, uses_of(dataset_detect, "test"))
    with pytest.raises(UserError, match=r"s004 = elsewhere/s004 \(trained\).*--allow-overlap"):
        _explain((detector, stack), dataset_detect, dataset_nav, tmp_path)
    store_record(detector, uses_of(dataset_detect, "train"))
    store_record(stack, uses_of(dataset_nav, "test"))
    with pytest.raises(UserError, match=r"s000 = elsewhere/s000 \(trained\).*--allow-overlap"):
        _explain((detector, stack), dataset_detect, dataset_nav, tmp_path)
    assert not (tmp_path / "explain").exists()
    # Each picture has the mark of its own network.
    run = _explain((detector, stack), dataset_detect, dataset_nav, tmp_path, allow_overlap=True)
    metrics = json.loads(run.metrics.read_text())
    assert (metrics["detector/terrain/status"], metrics["navigator/terrain/status"]) == ("disjoint", "overlap")
    assert "s000 = elsewhere/s000" in metrics["navigator/terrain/mark"]
    marked = {path.name for path in run.root.glob("*.png") if _banded(path)}
    assert marked == {"masks_navigate.png", "pcc_navigate.png"}
    table_mark = pq.read_schema(run.root / "correlations.parquet").metadata[b"terrain_mark"].decode()
    assert table_mark == f"navigator: {metrics['navigator/terrain/mark']}"


def test_the_crater_mask_holds_what_the_run_selects(checkpoints, dataset_detect):
    """A worn crater and one without contrast are background, though they are labelled."""
    settings = ExplainConfig(n_frames=8)
    config = config_of_run(checkpoints[0].parent.parent, ())
    _, truth, reported = detect_frames(settings, config, dataset_detect)
    labels = read_labels(open_dataset(dataset_detect), ["ellipse_cx_px", "ellipse_cy_px"], "test")
    seen = pd.Series(selected(labels, SELECTIONS["visible"]))
    values = {True: [], False: []}
    for (_, rows), mask in zip(labels.groupby("frame_id"), truth, strict=True):
        for row in rows.itertuples():
            expected = rows[seen[rows.index]]
            gap = np.hypot(expected["ellipse_cx_px"] - row.ellipse_cx_px, expected["ellipse_cy_px"] - row.ellipse_cy_px)
            if seen[row.Index] or (gap > 1.4 * expected["radius_px"] + 2).all():
                values[bool(seen[row.Index])].append(mask[int(row.ellipse_cy_px), int(row.ellipse_cx_px)])
    assert len(values[True]) > 10 and len(values[False]) > 5
    assert set(values[True]) == {0} and set(values[False]) == {1}
    assert reported["labels/min_contrast"] == 5


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


def test_all_gates_of_a_sheet_share_one_scale(tmp_path):
    """Gates of 0.2, 0.5 and 0.8 get three colours; one that varies has the same colour where it has the same value."""
    ramp = np.tile(np.linspace(0.2, 0.8, 160, dtype=np.float32), (160, 1))
    masks = {f"B_{k}": np.full((1, 160, 160), v, np.float32) for k, v in enumerate((0.2, 0.5, 0.8))} | {
        "B_3": ramp[None]
    }
    draw_masks(tmp_path / "sheet.png", np.full((1, 160, 160), 80, np.uint8), masks)
    sheet = cv2.imread(str(tmp_path / "sheet.png")).astype(int)
    low, middle, high = (sheet[80, 164 * (k + 1) + 82] for k in range(3))
    assert np.abs(low - middle).max() > 50 and np.abs(high - middle).max() > 50
    np.testing.assert_allclose(sheet[80, 164 * 4 + 82], middle, atol=6)
    # The colour bar below has the whole scale.
    np.testing.assert_allclose(sheet[-30, [42, -43]], [low, high], atol=6)
    assert caption("B_1", masks["B_1"][0]) == "B_1 constant 0.500"
    assert caption("B_3", masks["B_3"][0]) == "B_3 0.200-0.800"


def test_what_cannot_be_explained(checkpoints, dataset_detect, dataset_nav, tmp_path):
    detector, stack = checkpoints
    plain = store_run(tmp_path / "plain", "attention=none") / "checkpoints" / "best.ckpt"
    with pytest.raises(UserError, match="attention: got none"):
        _explain((plain, stack), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="no such file"):
        _explain((tmp_path / "missing.ckpt", stack), dataset_detect, dataset_nav, tmp_path)
    alone = tmp_path / "alone" / "checkpoints" / "best.ckpt"
    alone.parent.mkdir(parents=True)
    alone.write_bytes(detector.read_bytes())
    with pytest.raises(UserError, match=r"config\.yaml"):
        _explain((alone, stack), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="fusion"):
        _explain((detector, detector), dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match="kind: got nav"):
        _explain((detector, stack), dataset_nav, dataset_nav, tmp_path)
