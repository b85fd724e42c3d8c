"""Learning rate, stored features, summed gradients, and resume within an epoch."""

import numpy as np
import pytest
import torch

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.models.yolo import YOLOv3
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.train import task as tasks
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.motion.train.task import Initial, NavigationTask, learning_rate_factor
from perilune_train.training.runs import NamedRun, load_weights, save_weights

_NETWORK = {
    "size_px": 64,
    "width": 0.125,
    "hidden": 16,
    "sequence_pairs": 4,
    "batch_sequences": 1,
    "coarse_epochs": 2,
    "fine_epochs": 0,
    "learning_rate": 1e-2,
}


def settings(**changes):
    network = _NETWORK | changes
    return NavigateConfig(
        precision="float32", device="cpu", fusion="stack", warp=network, stack=network, checkpoint_minutes=0
    )


@pytest.fixture
def detector(tmp_path):
    """A detector whose whole backbone fits the stack network."""
    torch.manual_seed(3)
    architecture = {"in_channels": 1, "width": 0.125, "attention": "cbam_identity", "strides": [8, 16, 32]}
    save_weights(tmp_path / "best.ckpt", architecture, YOLOv3(None, **architecture))
    return tmp_path / "best.ckpt"


def weights(run):
    return torch.load(run.last, weights_only=True)["state_dict"]


def test_five_cosines_in_the_fine_stage():
    factors = np.array([learning_rate_factor(step, 100, 500, 5) for step in range(600)])
    np.testing.assert_allclose(factors[50:100], 1)
    for start in range(100, 600, 100):
        assert factors[start] == 1 and factors[start + 50] == pytest.approx(0.5) and factors[start + 99] < 0.001
    assert (np.diff(factors[100:200]) < 0).all()
    one = np.array([learning_rate_factor(step, 100, 500, 1) for step in range(600)])
    assert one[300] == pytest.approx(0.5) and (np.diff(one[60:]) < 0).all()


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_stored_features_give_the_weights_of_whole_epochs(dataset_nav, tmp_path, detector, monkeypatch):
    called = []
    original = tasks.stored_features
    monkeypatch.setattr(tasks, "stored_features", lambda *given: called.append(1) or original(*given))
    (stored,) = navigate_run(settings(), dataset_nav, NamedRun(tmp_path, "a"), detector)
    assert len(called) == 2, "train and val, once each"
    monkeypatch.setattr(NavigationTask, "stores", property(lambda self: False, lambda self, value: None), raising=False)
    (whole,) = navigate_run(settings(), dataset_nav, NamedRun(tmp_path, "b"), detector)
    assert len(called) == 2
    first, second = weights(stored), weights(whole)
    assert first.keys() == second.keys()
    for key, value in first.items():
        torch.testing.assert_close(value, second[key], atol=2e-4, rtol=1e-3, msg=key)
    start = load_weights(detector)["state_dict"]["backbone.stem.conv.weight"]
    assert torch.equal(first["network.backbone.stem.conv.weight"], start)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_a_kill_within_an_epoch_of_summed_gradients_changes_nothing(dataset_nav, tmp_path, monkeypatch):
    own = settings(coarse_epochs=0, fine_epochs=2, accumulate=2)
    (whole,) = navigate_run(own, dataset_nav, NamedRun(tmp_path, "whole"), None)
    original = NavigationTask.training_step

    def dies(self, batch, batch_idx):
        if self.current_epoch == 1 and batch_idx == 5:
            raise KeyError("killed")
        return original(self, batch, batch_idx)

    monkeypatch.setattr(NavigationTask, "training_step", dies)
    with pytest.raises(KeyError):
        navigate_run(own, dataset_nav, NamedRun(tmp_path, "again"), None)
    monkeypatch.undo()
    done = []
    monkeypatch.setattr(
        NavigationTask, "training_step", lambda self, batch, i: done.append(i) or original(self, batch, i)
    )
    (again,) = navigate_run(own, dataset_nav, NamedRun(tmp_path, "again"), None)
    # Batches 4 and 5 make the third step of the epoch; batch 4 was computed, but its step was not done.
    assert done[0] == 4
    first, second = weights(whole), weights(again)
    assert all(torch.equal(value, second[key]) for key, value in first.items())


def test_steps_of_summed_gradients_count_once(dataset_nav, monkeypatch):
    trajectories = load_trajectories(open_dataset(dataset_nav))
    task = NavigationTask(settings(coarse_epochs=0, fine_epochs=3, accumulate=3), "stack", trajectories)
    batches = len(task.train_dataloader())
    schedule = task.configure_optimizers()["lr_scheduler"]["scheduler"]
    total = 3 * -(-batches // 3)
    assert batches == 8 and schedule.lr_lambdas[0](total) < 1e-3 < schedule.lr_lambdas[0](total - 2)


def test_a_backbone_from_a_detector_learns_more_slowly(dataset_nav, detector):
    trajectories = load_trajectories(open_dataset(dataset_nav))
    backbone = {
        key.removeprefix("backbone."): value
        for key, value in load_weights(detector)["state_dict"].items()
        if key.startswith("backbone.")
    }
    for factor, rates in ((1.0, {1e-4}), (0.01, {1e-4, 1e-6})):
        own = settings(learning_rate=1e-4)
        own = own.model_copy(update={"stack": own.stack.model_copy(update={"backbone_factor": factor})})
        task = NavigationTask(own, "stack", trajectories, initial=Initial(backbone))
        groups = task.configure_optimizers()["optimizer"].param_groups
        assert {round(group["initial_lr"], 12) for group in groups if group["weight_decay"]} == rates
        slow = {id(value) for group in groups if group["initial_lr"] < 1e-5 for value in group["params"]}
        chosen = {name for name, value in task.network.named_parameters() if id(value) in slow}
        given = {name for name, _ in task.network.named_parameters() if name.startswith("backbone.")}
        assert chosen == (given if factor < 1 else set())
