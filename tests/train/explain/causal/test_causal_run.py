"""A whole run on drawn datasets, with untrained networks: its files, figures and claims."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from tests.helpers.drawn_dataset import build_dataset
from tests.helpers.stored_run import store_run
from tests.helpers.terrain_record import store_record

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.explain.causal.causal_run import CAPTIONS, CausalInputs, PoseInputs, causal_run
from perilune_train.explain.config import ExplainConfig
from perilune_train.models.navigator import StackNavigator
from perilune_train.records.provenance import training_provenance
from perilune_train.training.runs import NamedRun, save_weights

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
_NAV = {"splits": {"train": 1, "val": 1, "test": 6}, "n_frames": 2}


@pytest.fixture(scope="module")
def inputs(rendered, tmp_path_factory):
    """Detector, navigator, and two navigation datasets."""
    folder = tmp_path_factory.mktemp("inputs")
    torch.manual_seed(0)
    stack = folder / "stack.ckpt"
    navigator = StackNavigator(1, 0.125, "cbam_centred", 8)
    # Zero before training: no image would change an estimate.
    torch.nn.init.normal_(navigator.recurrent.output.weight)
    save_weights(stack, _STACK, navigator)
    detector = store_run(folder, "attention=cbam") / "checkpoints" / "best.ckpt"
    nav = build_dataset(folder / "nav", "nav", **_NAV)
    without = build_dataset(folder / "nav-without", "nav", removed={f"s{k:03d}": range(9) for k in range(8)}, **_NAV)
    store_record(detector, training_provenance(open_dataset(rendered.factual)).uses)
    store_record(stack, training_provenance(open_dataset(nav)).uses)
    return detector, stack, nav, without


def _run(rendered, detector, runs, **options):
    inputs = CausalInputs(rendered.factual, rendered.without, **options)
    return causal_run(ExplainConfig(device="cpu"), NamedRun(runs, "t"), detector, "B_11", inputs)


@pytest.mark.slow
def test_a_run_writes_effects_bins_claims_and_pictures(rendered, inputs, tmp_path):
    detector, stack, nav, without = inputs
    run = _run(rendered, detector, tmp_path, turned=rendered.factual, pose=PoseInputs(nav, without, stack))
    metrics = json.loads(run.metrics.read_text())
    moved = pd.read_parquet(run.root / "mask_effects.parquet")
    gates = moved["map"].unique()
    assert len(gates) == 23 and moved["scene_id"].nunique() == 6
    # Figures are means over views, recomputed from the table.
    own = moved[(moved["map"] == "B_22") & (moved["version"] == "rendered")]
    assert metrics["rendered/B_22"] == pytest.approx(own["change"].mean())
    small = own[(own["radius_px"] > 3) & (own["radius_px"] <= 5)]
    assert metrics["bins/rendered/B_22/radius_px/3-5"] == pytest.approx(small["change"].mean())
    assert metrics["bins/rendered/radius_px/3-5_n"] == len(small) > 0
    assert all(any(key.startswith(f"bins/rendered/{gate}/") for key in metrics) for gate in gates)
    # A turned Sun that is the same has the same masks.
    turned = pd.read_parquet(run.root / "turned_sun.parquet")
    assert turned["map"].nunique() == 23 and np.allclose(turned["pearson"].dropna(), 1, atol=1e-5)
    assert metrics["turned_sun/B_11"] == pytest.approx(1, abs=1e-5)
    assert metrics["pose/moved_m"] > 0
    claims = json.loads((run.root / "claims.json").read_text())
    assert len(claims) == 3 and all(list(one) == list(claims[0]) for one in claims)
    for claim, name in zip(claims, ("gate", "found", "pose"), strict=True):
        assert f"p {metrics[f'{name}_p']:.4f}" in claim["interval"] and "6 scenes" in claim["interval"]
        assert claim["verdict"] in ("holds", "does not hold")
    # An untrained detector does not find craters because of them.
    assert claims[1]["verdict"] == "does not hold"
    assert json.loads((run.root / "captions.json").read_text()) == CAPTIONS
    assert {path.name for path in run.root.glob("*.png")} == set(CAPTIONS)
    assert all(cv2.imread(str(run.root / name)).std() > 5 for name in CAPTIONS)
    before = {path: path.stat().st_mtime_ns for path in run.root.rglob("*")}
    _run(rendered, detector, tmp_path, turned=rendered.factual, pose=PoseInputs(nav, without, stack))
    assert {path: path.stat().st_mtime_ns for path in run.root.rglob("*")} == before


def test_faults_of_an_input_leave_no_run(rendered, inputs, tmp_path):
    detector, stack, nav, _ = inputs
    more = build_dataset(tmp_path / "more", "detect", splits={"train": 1, "val": 1, "test": 1}, n_frames=3)
    fewer = build_dataset(tmp_path / "fewer", "nav", **_NAV | {"n_frames": 3})
    runs = tmp_path / "runs"
    with pytest.raises(UserError, match=r"more.*: frames: got 3 frames, 2 of them in"):
        _run(rendered, detector, runs, turned=more)
    with pytest.raises(UserError, match=r"fewer.*: frames: got 3 frames of s002/t002"):
        _run(rendered, detector, runs, pose=PoseInputs(nav, fewer, stack))
    unseen = tmp_path / "unseen"
    shutil.copytree(rendered.without, unseen)
    rendered.removed.assign(crater_id=100_000).to_parquet(f"{unseen}.removed.parquet")
    with pytest.raises(UserError, match=r"craters of split test: got none of 24"):
        _run(replace(rendered, without=unseen), detector, runs)
    assert not runs.exists()
