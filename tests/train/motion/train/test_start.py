"""Training of `warp` from the weights of an earlier run, or from the installed navigator."""

import pytest
import torch

from perilune_shared.config.resolve import resolve
from perilune_shared.errors import UserError
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.shipped.models import weights_file
from perilune_train.training.runs import NamedRun, load_weights

QUICK = ("navigate.fusion=warp", "navigate.warp.fine_epochs=1", "navigate.warp.sequence_pairs=2")
SAME = ("navigate.warp.learning_rate=1e-9", "navigate.precision=float32", "navigate.device=cpu")


def settings(preset: str, *changes: str) -> NavigateConfig:
    return resolve(NavigateConfig, "navigate", "perilune_train", preset, None, (*QUICK, *changes))


@pytest.fixture(autouse=True)
def no_tables(monkeypatch):
    """Train without evaluation, which takes most of the time of a small run."""
    monkeypatch.setattr("perilune_train.motion.train.navigate_run.write_evaluation", lambda *_: None)
    monkeypatch.setattr("perilune_train.motion.train.navigate_run.calibrate", lambda *_: None)


def test_a_run_starts_from_the_installed_navigator(dataset_nav, tmp_path):
    (run,) = navigate_run(settings("demo", *SAME), dataset_nav, NamedRun(tmp_path, "a"), None)
    installed = load_weights(weights_file("lander-navigator"))
    trained = load_weights(run.best)
    assert trained["architecture"]["scales"] == installed["architecture"]["scales"]
    weights = [
        name for name, value in trained["state_dict"].items() if value.is_floating_point() and "running" not in name
    ]
    assert len(weights) > 50
    for name in weights:
        # Almost no learning rate: the weights of the start, rounded to half precision in the installed file.
        assert torch.allclose(trained["state_dict"][name], installed["state_dict"][name], atol=1e-5), name
    assert len(trained["terrain"]["uses"]) > len(installed["terrain"]["uses"])


@pytest.mark.parametrize(
    ("given", "field", "got"),
    [("absent.ckpt", "checkpoint", "no such file"), ("crater-detector", "architecture", "crater-detector")],
)
def test_a_start_that_does_not_fit(dataset_nav, tmp_path, given, field, got):
    config = settings("demo", f"navigate.init_from={given}")
    with pytest.raises(UserError) as error:
        navigate_run(config, dataset_nav, NamedRun(tmp_path, "a"), None)
    assert got in str(error.value)
    assert not any(tmp_path.iterdir())
