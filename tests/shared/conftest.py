"""Small datasets that tests of the manifest share."""

from pathlib import Path

import pytest

from tests.drawn_dataset import build_dataset


@pytest.fixture(scope="session")
def drawn(tmp_path_factory) -> Path:
    """Five terrains, one descent of 8 frames over each: 3 train, 1 val, 1 test. Read only."""
    return build_dataset(tmp_path_factory.mktemp("drawn") / "a", "detect")


@pytest.fixture(scope="session")
def other(tmp_path_factory) -> Path:
    """As `drawn`, on other terrains with the same names. Read only."""
    return build_dataset(tmp_path_factory.mktemp("drawn") / "b", "detect", seed=8)
