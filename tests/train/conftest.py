"""Small datasets that the trainer's tests share."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tests.drawn_dataset import build_dataset


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def make_dataset() -> Callable[..., Path]:
    """`build_dataset`, for tests that need a dataset of their own."""
    return build_dataset


@pytest.fixture(scope="session")
def dataset_detect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five terrains, one descent of 8 frames of 96 px over each: 3 train, 1 val, 1 test."""
    return build_dataset(tmp_path_factory.mktemp("detect") / "detect", "detect")


@pytest.fixture(scope="session")
def dataset_nav(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six descents of 8 frames of 96 px over one terrain: 4 train, 1 val, 1 test."""
    splits = {"train": 4, "val": 1, "test": 1}
    return build_dataset(tmp_path_factory.mktemp("nav") / "nav", "nav", splits=splits, scenes=1)
