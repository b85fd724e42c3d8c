"""Small datasets for the tests of this folder."""

import shutil
from pathlib import Path

import pytest
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.pack import pack


@pytest.fixture(scope="session")
def drawn(tmp_path_factory) -> Path:
    """Dataset of five terrains with one trajectory of 8 frames each: 3 train, 1 val, 1 test. Do not change it."""
    return build_dataset(tmp_path_factory.mktemp("drawn") / "a", "detect")


@pytest.fixture(scope="session")
def other(tmp_path_factory) -> Path:
    """Like `drawn`, with different terrains of the same names. Do not change it."""
    return build_dataset(tmp_path_factory.mktemp("drawn") / "b", "detect", seed=8)


@pytest.fixture(scope="session")
def crowded(tmp_path_factory) -> Path:
    """Dataset of 4 trajectories of 5 frames, each over its own terrain; frames are files."""
    root = tmp_path_factory.mktemp("crowded") / "set"
    return build_dataset(root, "detect", splits={"train": 2, "val": 1, "test": 1}, n_frames=5, side_px=128, craters=600)


@pytest.fixture(scope="session")
def crowded_packed(crowded, tmp_path_factory) -> Path:
    """The dataset `crowded`, packed: each table in one part, frames in shards."""
    out = tmp_path_factory.mktemp("packed") / "set"
    pack(open_dataset(crowded), out, shard_mb=0.1)
    return out


@pytest.fixture(scope="session")
def little(tmp_path_factory) -> Path:
    """Dataset of two terrains with one trajectory of three frames each, 32 px wide. Do not change it."""
    root = tmp_path_factory.mktemp("little") / "dataset"
    return build_dataset(root, "detect", side_px=32, splits={"train": 1, "val": 1}, n_frames=3, craters=300)


@pytest.fixture
def victim(little, tmp_path) -> Path:
    """A copy of `little` that a test may damage; the folder beside it must stay unchanged."""
    beside = tmp_path / "canary"
    beside.mkdir()
    (beside / "secret.txt").write_text("secret")
    (beside / "frames.parquet").write_bytes((little / "manifest/frames/all.parquet").read_bytes())
    (beside / "frame.png").write_bytes((little / "frames/s000/t000/000000.png").read_bytes())
    return Path(shutil.copytree(little, tmp_path / "dataset"))
