"""Hugging Face `datasets` opens packed frames as they are."""

import io

import numpy as np
import pytest
from PIL import Image

from perilune_shared.manifest import open_dataset


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """The library without its hub, its caches in a folder that goes away."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    return pytest.importorskip("datasets")


def test_shards_are_images(crowded_packed, offline, tmp_path):
    dataset = open_dataset(crowded_packed)
    shards = [str(shard) for shard in dataset.shards()]
    rows = offline.load_dataset("parquet", data_files=shards, split="train", cache_dir=str(tmp_path / "cache"))
    assert len(rows) == dataset.info.counts.frames and type(rows.features["image"]).__name__ == "Image"
    pngs = dict(dataset.pngs(dataset.table("frames")))
    for row in rows:
        assert np.array_equal(np.array(row["image"]), np.array(Image.open(io.BytesIO(pngs[row["frame_id"]]))))
