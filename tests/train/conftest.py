"""Small datasets, trained runs and a map that the trainer's tests share."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tests.helpers import in_process
from tests.helpers.drawn_dataset import build_dataset

from perilune_train.cli.main import main
from perilune_train.motion.config import NavigateConfig
from perilune_train.motion.train.navigate_run import navigate_run
from perilune_train.training.runs import NamedRun

DRAWING = {
    "perilune_train.detect.evaluate.report": ("draw_bins", "draw_curves", "draw_frames"),
    "perilune_train.motion.metrics.report": ("draw_trajectory", "draw_errors", "draw_pose_errors"),
}
"""Functions that write pictures, by the module that calls them."""


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations write no pictures, which take most of their time. For tests of everything else."""
    for module, names in DRAWING.items():
        for name in names:
            monkeypatch.setattr(f"{module}.{name}", lambda *_, **__: None)


@pytest.fixture(scope="session")
def make_dataset() -> Callable[..., Path]:
    """`build_dataset`, for tests that need a dataset of their own."""
    return build_dataset


@pytest.fixture(scope="session")
def dataset_detect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five terrains, one descent of 8 frames of 96 px over each: 3 train, 1 val, 1 test."""
    return build_dataset(tmp_path_factory.mktemp("detect") / "detect", "detect")


@pytest.fixture(scope="session")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `dataset_detect` with two frames of each descent: six to train on, two of val and of test."""
    return build_dataset(tmp_path_factory.mktemp("few") / "few", "detect", n_frames=2)


@pytest.fixture(scope="session")
def dataset_nav(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six descents of 8 frames of 96 px over one terrain: 4 train, 1 val, 1 test."""
    splits = {"train": 4, "val": 1, "test": 1}
    return build_dataset(tmp_path_factory.mktemp("nav") / "nav", "nav", splits=splits, scenes=1)


@pytest.fixture(scope="session")
def navigated(dataset_nav: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the runs `a` and `a-stack`: both networks, trained for an epoch. Their own files stay."""
    network = {"size_px": 64, "width": 0.125, "hidden": 16, "sequence_pairs": 4, "batch_sequences": 2}
    network |= {"coarse_epochs": 0, "fine_epochs": 1, "learning_rate": 1e-2}
    config = NavigateConfig(precision="float32", device="cpu", warp=network, stack=network)
    folder = tmp_path_factory.mktemp("runs")
    navigate_run(config, dataset_nav, NamedRun(folder, "a"), None)
    return folder / "navigate"


@pytest.fixture(scope="session")
def mapped(quick_survey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a rendered survey. Read only."""
    out = tmp_path_factory.mktemp("maps") / "map"
    done = in_process.call(main, "navigate", "map", "--dataset", quick_survey, "--out", out)
    assert done.returncode == 0, done.stderr
    return out
