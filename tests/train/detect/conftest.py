"""A trained run that the tests of training and of evaluation share."""

import pytest

from perilune_shared.config.resolve import resolve
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.train.detect_run import run_detect
from perilune_train.training.runs import RunFolder

QUICK = ("detect.epochs=2", "detect.width=0.125", "detect.precision=float32", "detect.device=cpu")
"""Settings of two epochs of a narrow network."""


@pytest.fixture(scope="session")
def finished(dataset_detect, tmp_path_factory) -> RunFolder:
    """A run with the settings QUICK. Its own files stay; an evaluation may add a folder."""
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, QUICK)
    return run_detect(config, dataset_detect, tmp_path_factory.mktemp("runs"), "a")
