"""A map that the tests of maps and of methods share."""

from pathlib import Path

import pytest
from tests.helpers import in_process

from perilune_train.cli import main


@pytest.fixture(scope="session")
def mapped(quick_survey, tmp_path_factory) -> Path:
    """The map of a rendered survey. Read only."""
    out = tmp_path_factory.mktemp("maps") / "map"
    done = in_process.call(main, "navigate", "map", "--dataset", quick_survey, "--out", out)
    assert done.returncode == 0, done.stderr
    return out
