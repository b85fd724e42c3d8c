"""Evaluation of a finished run on another dataset, pair by pair, and comparison of runs."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.cli.main import main
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.network import load_navigator, predict, predict_by_pairs


@pytest.fixture
def runs(navigated):
    return navigated


@pytest.fixture(scope="module")
def elsewhere(make_dataset, tmp_path_factory):
    """Another dataset with test frames only."""
    return make_dataset(tmp_path_factory.mktemp("elsewhere") / "b", "nav", splits={"test": 2}, n_frames=6, seed=9)


def call(*arguments):
    return in_process.call(main, "navigate", *map(str, arguments))


@pytest.mark.parametrize(("fusion", "name"), [("warp", "a"), ("stack", "a-stack")])
def test_pair_by_pair_gives_the_motions_of_the_whole_trajectory(runs, dataset_nav, fusion, name):
    network, architecture = load_navigator(runs / name / "checkpoints" / "best.ckpt", fusion)
    trajectory = load_trajectories(open_dataset(dataset_nav))[-1]
    whole = predict(network, architecture, trajectory)
    by_pairs, seconds = predict_by_pairs(network, architecture, trajectory)
    for one, other in zip(whole, by_pairs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    # Without the carried state the later motions differ.
    single = predict(network, architecture, _from(trajectory, 3))
    assert np.abs(single[0][0] - whole[0][3]).max() > 1e-7
    assert 0 < seconds < 5
    metrics = json.loads((runs / name / "metrics.json").read_text())
    assert metrics["test/ms_per_single_pair"] > 0


def _from(trajectory, start):
    """The trajectory without its first frames."""
    cut = {
        name: getattr(trajectory, name)[start:]
        for name in ("images", "position_m", "rotation_camera_from_site", "nominal_position_m")
    }
    return replace(trajectory, **cut)


@pytest.mark.usefixtures("no_pictures")
def test_a_run_is_evaluated_on_another_dataset(runs, elsewhere, tmp_path):
    done = call("evaluate", "--run", runs / "a-stack", "--dataset", elsewhere, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(tmp_path / "out" / "navigation.parquet").set_index("method")
    assert list(table.index) == ["stack", "klt", "klt_gyroscope", "alignment", "alignment_gyroscope", "nominal"]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["test/position_rmse_vector_m"] == pytest.approx(table.loc["stack", "position_rmse_vector_m"])
    assert (metrics["evaluation/method"], metrics["test/pairs"]) == ("stack", 10)
    assert metrics["terrain/status"] == "disjoint"


@pytest.mark.usefixtures("no_pictures")
def test_without_a_run_alignment_is_evaluated(elsewhere, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call("evaluate", "--dataset", elsewhere)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "runs/evaluation/alignment"
    table = pd.read_parquet(out / "navigation.parquet").set_index("method")
    assert list(table.index) == ["klt", "klt_gyroscope", "alignment", "alignment_gyroscope", "nominal"]
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["test/position_rmse_vector_m"] == pytest.approx(table.loc["alignment", "position_rmse_vector_m"])
    assert metrics["baseline/klt/position_rmse_vector_m"] == table.loc["klt", "position_rmse_vector_m"]
    assert (metrics["evaluation/method"], metrics["test/pairs"]) == ("alignment", 10)
    assert metrics["test/ms_per_single_pair"] > 0 and metrics["terrain/mark"] == ""


@pytest.mark.slow
def test_runs_and_evaluations_are_compared(runs, elsewhere, tmp_path):
    out = tmp_path / "out"
    assert call("evaluate", "--run", runs / "a", "--dataset", elsewhere, "--out", out).returncode == 0
    done = call("compare", runs / "a", runs / "a-stack", out, "--out", tmp_path / "compare")
    assert done.returncode == 0, done.stderr
    rows = [line for line in (tmp_path / "compare/compare.md").read_text().splitlines() if line.startswith("| ")][2:]
    methods = [row.split("|")[1].strip() for row in rows]
    assert methods[0] == "a (warp)" and methods.count("klt") == 2, "once for each dataset"
    assert any(method.startswith("a-stack (stack)") for method in methods)
    metrics = json.loads((runs / "a-stack" / "metrics.json").read_text())
    (own,) = [row for row in rows if "a-stack (stack)" in row]
    assert f"{metrics['test/position_rmse_vector_m']:.3f}" in own
    assert (tmp_path / "compare/errors.png").stat().st_size > 1000


def test_mistakes(runs, elsewhere, dataset_detect, tmp_path):
    cases = {
        ("--run", runs / "none", "--dataset", elsewhere): "no such file",
        ("--run", runs / "a", "--dataset", dataset_detect): "expected nav",
        ("--run", runs / "a", "--dataset", elsewhere, "--split", "tset"): "one of train, val, test",
        ("--run", runs / "a", "--dataset", elsewhere, "--out", runs / "a"): "the run's own folder",
    }
    for arguments, message in cases.items():
        done = call("evaluate", "--out", tmp_path / "out", *arguments)
        assert done.returncode == 2 and message in done.stderr, done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
    broken = shutil.copytree(runs / "a", tmp_path / "broken")
    (broken / "errors.parquet").write_bytes(b"PAR1")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/metrics.json").write_text("{}")
    for folder, message in ((broken, "errors.parquet"), (tmp_path / "empty", "evaluation/method")):
        done = call("compare", folder, "--out", tmp_path / "out")
        assert done.returncode == 2 and message in done.stderr and not (tmp_path / "out").exists()
