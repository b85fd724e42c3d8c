import json

import numpy as np
import pandas as pd
import pytest
import torch
from tests.train.motion.train.small_networks import NETWORK, saved_detector
from torch._subclasses.fake_tensor import FakeTensorMode

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.sequences import pair_sequence
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.network import Collate, Scales, load_navigator, predict, translation_units
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.motion.train.task import NavigationTask
from perilune_train.motion.train.windows import OutputUnits, Windows
from perilune_train.training.runs import NamedRun


def _settings(**changes):
    return NavigateConfig(
        **{"precision": "float32", "device": "cpu", "warp": NETWORK | {"jitter": 1.0}, "stack": NETWORK} | changes
    )


@pytest.fixture(scope="module")
def trajectories(dataset_nav):
    return load_trajectories(open_dataset(dataset_nav))


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    return saved_detector(tmp_path_factory.mktemp("detector"), "cbam_identity", [4, 8, 16])


@pytest.fixture(scope="module")
def runs(dataset_nav, tmp_path_factory, detector):
    """Both networks, trained for two epochs; the stack's backbone from a detector."""
    folder = tmp_path_factory.mktemp("runs")
    navigate_run(_settings(), dataset_nav, NamedRun(folder, "tiny", True), detector)
    return folder / "navigate"


def test_a_run_leaves_one_table_of_all_methods(runs):
    table = pd.read_parquet(runs / "tiny" / "navigation.parquet").set_index("method")
    classical = ["klt", "klt_gyroscope", "alignment", "alignment_gyroscope", "nominal"]
    assert list(table.index) == ["warp", "stack", *classical, "mean_at_step", "mean"]
    metrics = json.loads((runs / "tiny" / "metrics.json").read_text())
    assert metrics["test/position_rmse_vector_m"] == pytest.approx(table.loc["warp", "position_rmse_vector_m"])
    for method in ("klt", "nominal", "mean_at_step", "mean"):
        for key in ("position_rmse_vector_m", "orientation_rmse_angle_deg", "drift_rms_m"):
            assert metrics[f"baseline/{method}/{key}"] == pytest.approx(table.loc[method, key])
    # One test trajectory: its own value, and no interval.
    assert metrics["test/position_rmse_vector_m_interval"] is None
    own = [value for key, value in metrics.items() if key.startswith("test/position_rmse_vector_m/by_trajectory/")]
    assert own == pytest.approx([metrics["test/position_rmse_vector_m"]])
    stack = json.loads((runs / "tiny-stack" / "metrics.json").read_text())
    assert stack["test/drift_rms_m"] == pytest.approx(table.loc["stack", "drift_rms_m"])
    for name in ("tiny", "tiny-stack"):
        for file in ("config.yaml", "checkpoints/best.ckpt", "checkpoints/last.ckpt", "descent.png", "errors.png"):
            assert (runs / name / file).stat().st_size > 100, file


def test_the_table_of_pairs_agrees_with_the_summary(runs):
    pairs = pd.read_parquet(runs / "tiny" / "errors.parquet")
    table = pd.read_parquet(runs / "tiny" / "navigation.parquet").set_index("method")
    for method, own in pairs.groupby("method"):
        assert len(own) == 7
        assert np.sqrt((own["position_error_m"] ** 2).mean()) == pytest.approx(
            table.loc[method, "position_rmse_vector_m"]
        )


def test_the_saved_network_gives_the_figures_again(runs, trajectories):
    network, architecture = load_navigator(runs / "tiny" / "checkpoints" / "best.ckpt", "warp")
    test = next(d for d in trajectories if d.split == "test")
    translation, rotation = predict(network, architecture, test)
    own = pd.read_parquet(runs / "tiny" / "errors.parquet").query("method == 'warp'")
    np.testing.assert_allclose(np.linalg.norm(translation - test.motion[0], axis=1), own["position_error_m"], rtol=1e-4)
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-5)


@pytest.mark.usefixtures("no_pictures")
def test_a_killed_run_goes_on_to_the_same_weights(runs, dataset_nav, tmp_path, monkeypatch):
    settings = _settings(fusion="warp")
    original = NavigationTask.training_step

    def dies(self, batch, batch_idx):
        if self.current_epoch == 1 and batch_idx == 1:
            raise KeyError("killed")
        return original(self, batch, batch_idx)

    monkeypatch.setattr(NavigationTask, "training_step", dies)
    with pytest.raises(KeyError):
        navigate_run(settings, dataset_nav, NamedRun(tmp_path, "b"), None)
    monkeypatch.undo()
    (resumed,) = navigate_run(settings, dataset_nav, NamedRun(tmp_path, "b"), None)
    # Weights follow from the seed, whether the stack network was trained before or not.
    whole = runs / "tiny" / "checkpoints" / "last.ckpt"
    first, again = (torch.load(path, weights_only=True)["state_dict"] for path in (whole, resumed.last))
    assert first.keys() == again.keys()
    assert all(torch.equal(first[key], again[key]) for key in first)


def test_finished_runs_are_left_as_they_are(runs, dataset_nav, dataset_detect, detector, capsys):
    def files():
        # The lock comes and goes, which changes the time of the folder.
        return {path: path.stat().st_mtime_ns for path in runs.rglob("*") if path.is_file()}

    before = files()
    folders = navigate_run(_settings(), dataset_nav, NamedRun(runs.parent, "tiny"), detector)
    assert [run.root.name for run in folders] == ["tiny-stack", "tiny"]
    assert " ".join(capsys.readouterr().err.split()).count("finished, left unchanged") == 2
    with pytest.raises(UserError, match=r"tiny-stack.*inputs.json: dataset: got SHA-256 .*--overwrite"):
        navigate_run(_settings(), dataset_detect, NamedRun(runs.parent, "tiny"), detector)
    with pytest.raises(UserError, match=r"navigate.kappa: got 2.0, expected 1.0, as in the existing run"):
        navigate_run(_settings(kappa=2.0), dataset_nav, NamedRun(runs.parent, "tiny"), detector)
    assert files() == before


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_coarse_stage_leaves_the_detectors_backbone_alone(dataset_nav, tmp_path, detector):
    given = torch.load(detector, weights_only=True)["state_dict"]

    def backbone(coarse, fine):
        network = NETWORK | {"coarse_epochs": coarse, "fine_epochs": fine}
        (run,) = navigate_run(
            _settings(fusion="stack", stack=network), dataset_nav, NamedRun(tmp_path, "t", True), detector
        )
        state = torch.load(run.last, weights_only=True)["state_dict"]
        own = {key.removeprefix("network."): value for key, value in state.items()}
        return {key: value for key, value in own.items() if key.startswith("backbone.")}

    coarse = backbone(1, 0)
    # Weights and batch statistics alike; only the counter of batches may move.
    assert all(torch.equal(value, given[key]) for key, value in coarse.items())
    fine = backbone(1, 1)
    assert not torch.equal(fine["backbone.stem.conv.weight"], given["backbone.stem.conv.weight"])


@pytest.mark.usefixtures("no_pictures")
def test_a_detector_that_does_not_fit(dataset_nav, tmp_path, detector, capsys):
    settings = _settings(fusion="stack", stack=NETWORK | {"width": 0.25})
    (run,) = navigate_run(settings, dataset_nav, NamedRun(tmp_path, "t", True), detector)
    assert "width" in json.loads(run.metrics.read_text())["network/backbone"]
    with pytest.raises(UserError, match=r"width: got 0\.125"):
        navigate_run(
            settings.model_copy(update={"detector": detector}), dataset_nav, NamedRun(tmp_path, "t", True), None
        )
    with pytest.raises(UserError, match="fusion"):
        load_navigator(run.best, "warp")


def test_scales_by_hand(trajectories):
    training = [d for d in trajectories if d.split == "train"]
    translation = np.concatenate([d.motion[0] for d in training])
    stack = Scales.measured(training, "stack")
    np.testing.assert_allclose(stack.mean_m, translation.mean(0))
    np.testing.assert_allclose(stack.spread_m, translation.std(0))
    warp = Scales.measured(training, "warp")
    sequence = pair_sequence(training[0], 2, 3, warp=True)
    reference, unit = translation_units([sequence], warp, "warp")
    np.testing.assert_allclose(reference[0], training[0].nominal_motion[0][2:5], rtol=1e-5)
    residual = translation - np.concatenate([d.nominal_motion[0] for d in training])
    across = np.sqrt((residual[:, :2] ** 2).mean())
    np.testing.assert_allclose(unit, [across, across, np.sqrt((residual[:, 2] ** 2).mean())], rtol=1e-5)


def test_outputs_made_from_the_truth_have_no_loss(trajectories, monkeypatch):
    """The loss agrees with `Scales` on what an output means."""
    task = NavigationTask(_settings(), "stack", trajectories)
    sequence = pair_sequence(trajectories[0].shrunk(64), 0, 4, warp=False)
    columns = np.concatenate([sequence.rotation_c2_from_c1[:, :, 0], sequence.rotation_c2_from_c1[:, :, 1]], axis=1)
    truth = np.concatenate(
        [
            (sequence.translation_m - task.scales.mean_m) / task.scales.spread_m,
            (columns - [1, 0, 0, 0, 1, 0]) / task.scales.rotation_rad,
        ],
        axis=1,
    )
    monkeypatch.setattr(task, "log_dict", lambda *_, **__: None)

    class Gives(torch.nn.Module):
        def __init__(self, output):
            super().__init__()
            self.output = torch.from_numpy(output)[None].float()

        def forward(self, first, second, state=None):
            return self.output, state

    task.windows = Windows(task.training_trajectories, [0], 4, OutputUnits("motion", task.scales), torch.device("cpu"))

    def loss(output):
        task.network = Gives(output)
        return float(task.training_step(torch.tensor([[0, 0]]), 0))

    assert loss(truth) == pytest.approx(0, abs=1e-6)
    # One unit too far in x at one of four pairs: a quarter.
    assert loss(truth + np.eye(4, 9) * np.array([1, 0, 0, 0])[:, None]) == pytest.approx(0.25, abs=1e-5)


def test_no_training_step_needs_a_value(trajectories, monkeypatch):
    """A GPU would have to be waited for. Fake tensors have no values: an operation that needs one raises an error."""
    task = NavigationTask(_settings(), "warp", trajectories)
    for name in ("log", "log_dict"):
        monkeypatch.setattr(task, name, lambda *_, **__: None)
    sequences = [pair_sequence(trajectories[i].shrunk(64), 0, 4, warp=True) for i in (0, 1)]
    batch = Collate(task.scales, "warp")(sequences)
    assert batch.flow_px is not None
    with FakeTensorMode(allow_non_fake_inputs=True) as fake:
        task.training_step(batch.each(fake.from_tensor), 0).backward()
