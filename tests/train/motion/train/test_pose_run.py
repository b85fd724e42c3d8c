"""Runs that learn the pose in O_L: their files, resuming, and the commands that read them."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from tests.helpers import in_process
from tests.train.motion.train.small_networks import pose_settings, saved_detector

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.explain.evidence.performance import MotionPerformance
from perilune_train.explain.inputs import consecutive_pairs
from perilune_train.explain.navigation import untrained_navigator
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.network import load_navigator
from perilune_train.motion.pose import (
    predict_pose,
    predict_pose_by_pairs,
)
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.motion.train.task import NavigationTask
from perilune_train.report.navigation import navigation_section
from perilune_train.report.sources import read_run
from perilune_train.training.runs import NamedRun


def settings(fusion="stack", **changes):
    return pose_settings(changes.pop("attention", "cbam_last"), fusion, **changes)


@pytest.fixture(scope="module")
def trajectories(dataset_nav):
    return load_trajectories(open_dataset(dataset_nav))


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    """A detector whose whole backbone fits the stack network."""
    return saved_detector(tmp_path_factory.mktemp("detector"), "cbam_last", [8, 16, 32])


@pytest.fixture(scope="module")
def run(dataset_nav, tmp_path_factory, detector):
    """A finished run, with views; its files stay."""
    (own,) = navigate_run(settings(views=1), dataset_nav, NamedRun(tmp_path_factory.mktemp("runs"), "p"), detector)
    return own


def call(*arguments):
    return in_process.call(main, *map(str, arguments))


def test_several_landing_areas_are_refused_before_training(make_dataset, tmp_path):
    data = make_dataset(tmp_path / "data", "nav", n_frames=2)
    with pytest.raises(UserError, match=r"scenes: got 5, expected 1, the landing area") as error:
        navigate_run(settings(), data, NamedRun(tmp_path / "runs", "p"), None)
    assert "\n" not in str(error.value) and not (tmp_path / "runs").exists()


def test_a_run_leaves_its_floors_and_its_page(run, trajectories):
    table = pd.read_parquet(run.root / "navigation.parquet").set_index("method")
    assert list(table.index) == ["stack", "mean_pose", "mean_pose_at_frame", "ridge"]
    metrics = json.loads(run.metrics.read_text())
    assert metrics["evaluation/target"] == "pose" and metrics["test/ms_per_single_pair"] > 0
    for method, prefix in (("stack", "test"), ("ridge", "baseline/ridge"), ("mean_pose", "baseline/mean_pose")):
        for key in ("position_rmse_per_component_m", "position_error_median_m", "orientation_rmse_angle_deg"):
            assert metrics[f"{prefix}/{key}"] == pytest.approx(table.loc[method, key])
    floors = table["position_rmse_per_component_m"].drop("stack")
    loses = floors.min() <= table.loc["stack", "position_rmse_per_component_m"]
    assert metrics["evaluation/worse_than"] == (floors.idxmin() if loses else "")
    page = (run.root / "pose.md").read_text()
    assert ("worse than" in page) == loses and "mean pose of the training at that frame" in page
    pairs = pd.read_parquet(run.root / "errors.parquet")
    assert len(pairs) == 4 * 7 and (run.root / "errors.png").stat().st_size > 1000
    network, architecture = load_navigator(run.best, "stack")
    position, _ = predict_pose(network, architecture, trajectories[-1])
    own = pairs.query("method == 'stack'")
    np.testing.assert_allclose(
        np.linalg.norm(position - trajectories[-1].position_m[1:], axis=1), own["position_error_m"], rtol=1e-4
    )


def test_pair_by_pair_gives_the_poses_of_the_whole_trajectory(run, trajectories):
    network, architecture = load_navigator(run.best, "stack")
    assert isinstance(network, StackNavigator) and architecture["sequence_pairs"] < trajectories[-1].n_pairs
    whole = predict_pose(network, architecture, trajectories[-1])
    by_pairs, seconds = predict_pose_by_pairs(network, architecture, trajectories[-1])
    np.testing.assert_allclose(by_pairs[0], whole[0], atol=1e-2)
    np.testing.assert_allclose(by_pairs[1], whole[1], atol=1e-5)
    assert 0 < seconds < 5


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize(("epoch", "batch"), [(1, 2), (2, 1)])
def test_a_killed_run_goes_on_to_the_same_weights(run, dataset_nav, tmp_path, detector, monkeypatch, epoch, batch):
    """In the coarse stage and in the fine one, with dropout and views."""
    own = settings(views=1).model_copy(update={"checkpoint_minutes": 0.0})
    original = NavigationTask.training_step

    def dies(self, given, batch_idx):
        if self.current_epoch == epoch and batch_idx == batch:
            raise KeyError("killed")
        return original(self, given, batch_idx)

    monkeypatch.setattr(NavigationTask, "training_step", dies)
    with pytest.raises(KeyError):
        navigate_run(own, dataset_nav, NamedRun(tmp_path, "b"), detector)
    monkeypatch.undo()
    done = []
    monkeypatch.setattr(
        NavigationTask, "training_step", lambda self, given, i: done.append(i) or original(self, given, i)
    )
    (resumed,) = navigate_run(own, dataset_nav, NamedRun(tmp_path, "b"), detector)
    assert done[0] == batch
    first, again = (torch.load(one.last, weights_only=True)["state_dict"] for one in (run, resumed))
    assert all(torch.equal(first[key], again[key]) for key in first)


def test_the_fine_stage_trains_the_backbone_with_the_detectors_statistics(run, detector):
    given = torch.load(detector, weights_only=True)["state_dict"]
    own = torch.load(run.last, weights_only=True)["state_dict"]
    # Those of the gates too, which have no weight.
    statistics = [key for key in given if key.startswith("backbone.") and "running" in key]
    assert any("attentions" in key for key in statistics)
    assert all(torch.equal(own[f"network.{key}"], given[key]) for key in statistics)
    assert not torch.equal(own["network.backbone.stem.conv.weight"], given["backbone.stem.conv.weight"])


def test_short_coarse_epochs_are_validated_ten_times(dataset_nav, tmp_path, detector, monkeypatch, no_pictures):
    validated = []
    original = NavigationTask.on_validation_epoch_end
    monkeypatch.setattr(
        NavigationTask,
        "on_validation_epoch_end",
        lambda self: validated.append(self.current_epoch + 1) or original(self),
    )
    own = settings(coarse_epochs=25, fine_epochs=1, batch_sequences=8)
    navigate_run(own, dataset_nav, NamedRun(tmp_path, "a"), detector)
    assert validated == [*range(2, 25, 2), 25, 26]


def test_commands_take_a_run_of_poses(run, dataset_nav, make_dataset, tmp_path, no_pictures):
    done = call("navigate", "evaluate", "--run", run.root, "--dataset", dataset_nav, "--out", tmp_path / "e")
    assert done.returncode == 0, done.stderr
    found, own = (json.loads((folder / "metrics.json").read_text()) for folder in (tmp_path / "e", run.root))
    assert found["test/position_rmse_vector_m"] == pytest.approx(own["test/position_rmse_vector_m"], rel=1e-4)
    key = "baseline/mean_pose/position_rmse_vector_m"
    assert found[key] == pytest.approx(own[key])
    done = call("navigate", "compare", run.root, tmp_path / "e", "--out", tmp_path / "c")
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "c" / "compare.md").read_text()
    assert text.count("(stack, pose)") == 2 and text.count("mean_pose_at_frame") == 1
    elsewhere = make_dataset(tmp_path / "other", "nav", splits={"test": 1}, n_frames=4, seed=9)
    done = call("navigate", "evaluate", "--run", run.root, "--dataset", elsewhere, "--out", tmp_path / "f")
    assert done.returncode == 2 and re.search("terrain: got other terrain, expected the landing area", _one_line(done))
    done = call("navigate", "deploy", "--run", run.root, "--out", tmp_path / "x")
    assert done.returncode == 2 and "target: got pose, expected a network trained with target=motion" in _one_line(done)
    assert not (tmp_path / "f").exists() and not (tmp_path / "x").exists()


def _one_line(done):
    return " ".join(done.stderr.split())


def test_the_report_shows_poses_beside_their_floors(run):
    opened = read_run(run.root, run.root.parent.parent)
    section = navigation_section([opened], None)
    (table,) = section.tables
    assert table.caption == "Pose in the landing frame" and len(table.rows) == 4
    loses = opened.metrics["evaluation/worse_than"]
    assert table.rows[0][0] == (f"p-stack, worse than {loses}" if loses else "p-stack")
    assert (
        "in its poses" in section.lead[0]
        and (not loses or f"worse than {loses}" in section.lead[0])
        and len(section.figures) == 1
    )


def test_explanations_measure_the_position(run, trajectories):
    """The position error of pairs whose window begins at the start of the trajectory."""
    network, architecture = load_navigator(run.best, "stack")
    descent, n_pairs = trajectories[-1], architecture["sequence_pairs"]
    pairs = consecutive_pairs([cut(descent, n_pairs)], n_pairs)
    scales = [np.array(architecture["scales"][key]) for key in ("mean_m", "spread_m")]
    performance = MotionPerformance(network, pairs.position_m, *scales, architecture["size_px"])
    position_m, _ = predict_pose(network, architecture, descent)
    expected = np.linalg.norm(position_m - descent.position_m[1:], axis=1)[:n_pairs]
    np.testing.assert_allclose(performance(pairs.images), expected, rtol=1e-4)
    assert untrained_navigator(network, architecture, pairs.images, 0).pool == 2


def cut(descent, n_pairs):
    """The first pairs of a trajectory."""
    names = ("images", "position_m", "rotation_camera_from_site", "nominal_position_m")
    return replace(descent, **{name: getattr(descent, name)[: n_pairs + 1] for name in names})
