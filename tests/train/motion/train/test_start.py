"""Training of `warp` from the weights of an earlier run."""

import pytest
import torch

from perilune_shared.errors import UserError
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.shipped.models import WEIGHTS, shipped_run
from perilune_train.training.runs import NamedRun, RunFolder, load_weights

NETWORK = {"size_px": 64, "width": 0.125, "hidden": 16, "sequence_pairs": 2, "batch_sequences": 2}
"""The network of the fixture `navigated`."""
# The learning rate is almost zero, so the weights hardly change.
NETWORK |= {"coarse_epochs": 0, "fine_epochs": 1, "learning_rate": 1e-9}


def settings(start: object) -> NavigateConfig:
    network = dict(precision="float32", device="cpu", warp=NETWORK, stack=NETWORK)
    return NavigateConfig(fusion="warp", init_from=str(start), **network)


@pytest.fixture(autouse=True)
def no_tables(monkeypatch):
    """Train without evaluation, which takes most of the time of a small run."""
    monkeypatch.setattr("perilune_train.motion.train.navigate_run.write_evaluation", lambda *_: None)
    monkeypatch.setattr("perilune_train.motion.train.navigate_run.calibrate", lambda *_: None)


def test_a_run_starts_from_an_earlier_run(navigated, make_dataset, tmp_path):
    splits = {"train": 2, "val": 1, "test": 1}
    other = make_dataset(tmp_path / "other", "nav", splits=splits, n_frames=4, seed=9)
    start = RunFolder(navigated / "a").best
    (run,) = navigate_run(settings(start), other, NamedRun(tmp_path, "b"), None)
    before, trained = load_weights(start), load_weights(run.best)
    assert trained["architecture"]["scales"] == before["architecture"]["scales"]
    weights = [
        name for name, value in trained["state_dict"].items() if value.is_floating_point() and "running" not in name
    ]
    assert len(weights) > 50
    for name in weights:
        assert torch.allclose(trained["state_dict"][name], before["state_dict"][name], atol=1e-5), name
    assert len(trained["terrain"]["uses"]) > len(before["terrain"]["uses"])


@pytest.mark.parametrize("given", ["absent.ckpt", "detector"])
def test_a_start_that_does_not_fit(dataset_nav, tmp_path, given):
    start = shipped_run("detect") / WEIGHTS if given == "detector" else given
    with pytest.raises(UserError) as error:
        navigate_run(settings(start), dataset_nav, NamedRun(tmp_path, "a"), None)
    assert {"absent.ckpt": "no such file", "detector": "crater-detector"}[given] in str(error.value)
    assert not any(tmp_path.iterdir())
