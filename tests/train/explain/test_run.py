import json

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from tests.helpers import in_process
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record, uses_of

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.cli.detect import config_of_run
from perilune_train.cli.main import main
from perilune_train.detect.inference.detector import load_detector
from perilune_train.explain import explain_run as explained
from perilune_train.explain.config import ExplainConfig
from perilune_train.explain.evidence.tables import TABLES
from perilune_train.explain.explain_run import NetworkOnData, explain_run
from perilune_train.explain.inputs import labelled_frames
from perilune_train.explain.maps.masks import detector_masks
from perilune_train.explain.page.pictures import CAPTIONS
from perilune_train.models.navigator import StackNavigator
from perilune_train.records.provenance import training_provenance
from perilune_train.shipped.models import shipped_run
from perilune_train.training.runs import NamedRun, RunFolder, save_weights

_BLOCKS = [f"B_{i + 1}{j + 1}" for i, count in enumerate((1, 2, 8, 8, 4)) for j in range(count)]
_STACK = {
    "fusion": "stack",
    "size_px": 64,
    "in_channels": 1,
    "width": 0.125,
    "attention": "cbam_centred",
    "hidden": 8,
    "focal_over_width": 1.4,
    "scales": {"mean_m": [0.0] * 3, "spread_m": [1.0] * 3, "rotation_rad": 0.01},
}


def _store(folder):
    """Untrained networks: their masks are as real as trained ones."""
    torch.manual_seed(0)
    save_weights(folder / "stack.ckpt", _STACK, StackNavigator(1, 0.125, "cbam_centred", 8))
    return store_run(folder, "attention=cbam") / "checkpoints" / "best.ckpt", folder / "stack.ckpt"


@pytest.fixture(scope="module")
def checkpoints(dataset_detect, dataset_nav, tmp_path_factory):
    """A detector and a stack navigator with the records that training on the two datasets leaves."""
    stored = _store(tmp_path_factory.mktemp("checkpoints"))
    for path, dataset in zip(stored, (dataset_detect, dataset_nav), strict=True):
        store_record(path, training_provenance(open_dataset(dataset)).uses)
    return stored


def _explain(checkpoints, dataset_detect, dataset_nav, folder, n_drawn=2, **options):
    settings = ExplainConfig(
        n_frames=3,
        n_pairs=8,
        n_validation=8,
        n_changed=2,
        n_changed_pairs=8,
        n_attributed=1,
        n_drawn=n_drawn,
        integration_steps=2,
        occlusion_px=48,
        device="cpu",
    )
    overwrite = options.pop("overwrite", False)
    networks = [
        None if checkpoint is None else NetworkOnData(checkpoint, dataset)
        for checkpoint, dataset in zip(checkpoints, (dataset_detect, dataset_nav), strict=True)
    ]
    return explain_run(settings, NamedRun(folder, "t", overwrite), *networks, **options)


def _banded(path):
    """Whether a picture has the red band of a terrain mark."""
    blue, green, red = cv2.imread(str(path))[1, 1].astype(int)
    return red > 150 and max(blue, green) < 80


@pytest.mark.slow
def test_a_run_writes_values_tests_interventions_claims_and_pictures(
    checkpoints, dataset_detect, dataset_nav, tmp_path
):
    run = _explain(checkpoints, dataset_detect, dataset_nav, tmp_path)
    tables = {name: pd.read_parquet(run.root / f"{name}.parquet") for name in TABLES}
    gates = tables["values"].query("kind == 'gate'")
    for measure, count in (("pcc1_craterness", 3), ("pcc1_partial", 3), ("pcc2", 3), ("pcc3", 7), ("pcc4", 7)):
        own = gates[gates["measure"] == measure]
        assert list(dict.fromkeys(own["map"])) == _BLOCKS
        assert (own.groupby("map").size() == count).all()
        assert own["value"].abs().max() <= 1 + 1e-9
    metrics = json.loads(run.metrics.read_text())
    # The sign: G is 1 on background. Compare with NumPy.
    config = config_of_run(checkpoints[0].parent.parent, ())
    settings = ExplainConfig(n_frames=3)
    frames, _ = labelled_frames(open_dataset(dataset_detect), "test", config, 3, settings.ring_factors)
    masks = detector_masks(load_detector(checkpoints[0]), frames.images, tmp_path)["B_11"]
    pairs = zip(masks, frames.truth, strict=True)
    mean = np.mean([np.corrcoef(mask.ravel(), g.ravel())[0, 1] for mask, g in pairs])
    assert metrics["pcc1_background/B_11"] == pytest.approx(mean, abs=1e-5)
    assert metrics["pcc1_craterness/B_11"] == pytest.approx(-mean, abs=1e-5)
    assert "weaker on craters" in metrics["pcc1_sign"] and metrics["labels/selection"] == "visible"
    # All 23 gates, the 4 stages with several gates and all together are forced, in both tasks.
    forced = tables["gates"]
    assert forced.groupby("task")["scope"].nunique().to_dict() == {"detect": 28, "navigate": 28}
    assert (forced.groupby("task")["scene_id"].nunique() >= 1).all()
    nav = forced[(forced["task"] == "navigate") & (forced["scope"] == "all gates")]
    assert np.isfinite(nav["after"]).all() and (nav["after"] > 0).all()
    assert set(tables["removal"]["which"]) == {"most", "least", "random", "shifted"}
    assert set(tables["randomisation"]["direction"]) == {"top_down", "bottom_up"}
    # One or two scenes allow no interval and no verdict.
    assert tables["summary"].query("task == 'detect'")["low"].isna().all()
    assert not tables["tested"]["beats_all"].any()
    claims = json.loads((run.root / "claims.json").read_text())
    assert len(claims) == 18 and all(set(one) == set(claims[0]) for one in claims)
    assert {(run.root / one["picture"]).is_file() for one in claims} == {True}
    verdicts = [one["verdict"] for one in claims if "is constant" not in one["claim"]]
    assert all(verdict.startswith("undecided") for verdict in verdicts)
    assert "follows craters" in metrics["headline"] and "PCC4" in metrics["headline"]
    assert metrics["headline"].count("removing what it attends to hurts more than controls and edges: undecided") == 2
    # Every figure of the page is on record: nulls, forced gates, removed pixels, stability, random weights.
    for key in (
        "pcc1_craterness_null/B_11/edge",
        "auc_null/B_11/untrained",
        "detect/forced/all gates",
        "detect/removal/craters/inpaint/most",
        "detect/removal/craters/mean/random",
        "detect/stability/noise 2 DN/B_11",
        "detect/randomised/bottom_up/stage 1/B_11",
        "auc/occlusion",
        "pcc4_minus_pcc3_null/B_11/contrast",
    ):
        assert isinstance(metrics[key], float), key
    assert any(key.startswith("navigate/removal/edge/stage_") and key.endswith("/most") for key in metrics)
    captions = json.loads((run.root / "captions.json").read_text())
    assert captions == CAPTIONS and {path.name for path in run.root.glob("*.png")} == set(captions)
    for name in captions:
        assert cv2.imread(str(run.root / name)).std() > 5, name
        assert not _banded(run.root / name), name
    # The detection dataset splits by scene, the navigation dataset by trajectory.
    assert (metrics["detector/terrain/status"], metrics["detector/terrain/mark"]) == ("disjoint", "")
    assert (metrics["navigator/terrain/status"], metrics["navigator/terrain/mark"]) == ("by protocol", "")
    with np.load(run.root / "masks_detect.npz", allow_pickle=False) as stored:
        assert list(stored["blocks"]) == _BLOCKS and stored["B_11"].dtype == np.uint8
        assert len(stored["B_54"]) == len(stored["frame_ids"]) > 1
        low, high = stored["low"][0], stored["high"][0]
        assert 0 < low < high < 1  # plain gates
    # The same again leaves it alone; other settings or another checkpoint are refused.
    before = {path: path.stat().st_mtime_ns for path in run.root.rglob("*")}
    _explain(checkpoints, dataset_detect, dataset_nav, tmp_path)
    with pytest.raises(UserError, match=r"explain.n_drawn: got 1, expected 2, as in the existing run; --overwrite"):
        _explain(checkpoints, dataset_detect, dataset_nav, tmp_path, n_drawn=1)
    with pytest.raises(UserError, match=r"inputs.json: detector: got SHA-256 .*--overwrite"):
        _explain((checkpoints[1], checkpoints[1]), dataset_detect, dataset_nav, tmp_path)
    assert {path: path.stat().st_mtime_ns for path in run.root.rglob("*")} == before


@pytest.fixture
def overlapping(dataset_detect, dataset_nav, tmp_path):
    """A detector that was fitted to other terrain, and a navigator that was fitted to test terrain."""
    detector, stack = _store(tmp_path / "networks")
    store_record(detector, uses_of(dataset_detect, "train"))
    store_record(stack, uses_of(dataset_nav, "test"))
    return detector, stack


def test_test_terrain_that_a_network_was_fitted_to_is_refused(overlapping, dataset_detect, dataset_nav, tmp_path):
    with pytest.raises(UserError, match=r"s000 = elsewhere/s000 \(trained\).*--allow-overlap"):
        _explain(overlapping, dataset_detect, dataset_nav, tmp_path)
    store_record(overlapping[0], uses_of(dataset_detect, "test"))
    with pytest.raises(UserError, match=r"s004 = elsewhere/s004 \(trained\).*--allow-overlap"):
        _explain(overlapping, dataset_detect, dataset_nav, tmp_path)
    assert not (tmp_path / "explain").exists()


@pytest.mark.slow
def test_each_picture_has_the_mark_of_its_own_network(overlapping, dataset_detect, dataset_nav, tmp_path):
    run = _explain(overlapping, dataset_detect, dataset_nav, tmp_path, allow_overlap=True)
    metrics = json.loads(run.metrics.read_text())
    assert (metrics["detector/terrain/status"], metrics["navigator/terrain/status"]) == ("disjoint", "overlap")
    assert "s000 = elsewhere/s000" in metrics["navigator/terrain/mark"]
    marked = {path.name for path in run.root.glob("*.png") if _banded(path)}
    assert marked == {name for name in CAPTIONS if "navigate" in name}
    table_mark = pq.read_schema(run.root / "summary.parquet").metadata[b"terrain_mark"].decode()
    assert table_mark == f"navigator: {metrics['navigator/terrain/mark']}"


@pytest.mark.slow
def test_one_network_alone(checkpoints, dataset_detect, tmp_path):
    """No navigator and no navigation dataset are needed to explain a detector."""
    run = _explain((checkpoints[0], None), dataset_detect, "missing", tmp_path)
    assert {path.name for path in run.root.glob("*.png")} == {name for name in CAPTIONS if "detect" in name}
    assert set(json.loads((run.root / "captions.json").read_text())) == {name for name in CAPTIONS if "detect" in name}
    assert set(pd.read_parquet(run.root / "gates.parquet")["task"]) == {"detect"}
    claims, metrics = (json.loads((run.root / name).read_text()) for name in ("claims.json", "metrics.json"))
    assert len(claims) == 11 and not any("Navigator" in one["claim"] for one in claims)
    assert metrics["headline"].startswith("Detector: ") and "Navigator" not in metrics["headline"]
    assert not any("navigat" in key for key in metrics)
    assert "navigat" not in (run.root / "inputs.json").read_text()


def test_the_task_chooses_the_networks(dataset_detect, tmp_path, monkeypatch):
    """Without a run of that name the installed detector is explained; a network of the other task is refused."""
    calls = []
    monkeypatch.setattr(explained, "explain_run", lambda *given: calls.append(given) or RunFolder(tmp_path / "made"))
    common = ("explain", "--out", tmp_path, "--name", "a", "--dataset", "data")
    assert in_process.call(main, *common, "--task", "detect").returncode == 0
    assert calls[-1][2:4] == (NetworkOnData(shipped_run("detect") / "weights.safetensors", "data/detect"), None)
    (tmp_path / "detect" / "a").mkdir(parents=True)
    assert in_process.call(main, *common, "--task", "detect").returncode == 0
    detector = NetworkOnData(tmp_path / "detect/a/checkpoints/best.ckpt", "data/detect")
    navigator = NetworkOnData(tmp_path / "navigate/a-stack/checkpoints/best.ckpt", "data/nav")
    assert calls[-1][2:4] == (detector, None)
    assert in_process.call(main, *common).returncode == 0 and calls[-1][2:4] == (detector, navigator)
    assert in_process.call(main, *common, "--task", "navigate").returncode == 0 and calls[-1][2:4] == (None, navigator)
    refused = in_process.call(main, *common, "--task", "detect", "--navigator", "a.ckpt")
    assert refused.returncode == 2 and refused.stderr.startswith("error: --navigator: got a.ckpt, expected")


def test_the_crater_mask_holds_what_the_run_selects(checkpoints, dataset_detect):
    """A worn crater and one without contrast are background, though they are labelled."""
    config = config_of_run(checkpoints[0].parent.parent, ())
    frames, _ = labelled_frames(open_dataset(dataset_detect), "test", config, 8, (1.1, 1.2, 1.3, 1.4))
    labels = read_labels(open_dataset(dataset_detect), ["ellipse_cx_px", "ellipse_cy_px"], "test")
    seen = pd.Series(selected(labels, SELECTIONS["visible"]))
    values = {True: [], False: []}
    for (_, rows), mask in zip(labels.groupby("frame_id"), frames.truth, strict=True):
        for row in rows.itertuples():
            expected = rows[seen[rows.index]]
            gap = np.hypot(expected["ellipse_cx_px"] - row.ellipse_cx_px, expected["ellipse_cy_px"] - row.ellipse_cy_px)
            if seen[row.Index] or (gap > 1.4 * expected["radius_px"] + 2).all():
                values[bool(seen[row.Index])].append(mask[int(row.ellipse_cy_px), int(row.ellipse_cx_px)])
    assert len(values[True]) > 10 and len(values[False]) > 5
    assert set(values[True]) == {0} and set(values[False]) == {1}


def test_what_cannot_be_explained(checkpoints, dataset_detect, dataset_nav, tmp_path):
    detector, stack = checkpoints
    plain = store_run(tmp_path / "plain", "attention=none") / "checkpoints" / "best.ckpt"
    store_record(plain, training_provenance(open_dataset(dataset_detect)).uses)
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
