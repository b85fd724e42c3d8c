"""Small datasets and a trained run that the trainer's tests share."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tests.helpers.drawn_dataset import build_dataset

DRAWING = {
    "perilune_train.detect.evaluate.report": ("draw_bins", "draw_curves", "draw_frames"),
    "perilune_train.navigate.evaluate.report": ("draw_trajectory", "draw_errors"),
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
