"""Hugging Face `datasets` loads the splits of an export and of shards, and does not mix them."""

import io
import shutil

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from rich.progress import Progress

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.export.card import write_card
from perilune_shared.export.hugging_face import export_hugging_face
from perilune_shared.export.rows import by_selection
from perilune_shared.labels.thresholds import SELECTIONS


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """Use the library without network and with its caches in a temporary folder."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    return pytest.importorskip("datasets")


def check_rows(dataset, split, rows):
    """Check that rows are all frames of a split, with their images, poses and labels."""
    frames = dataset.table("frames", split=split).to_pandas().set_index("frame_id")
    pngs = dict(dataset.pngs(dataset.table("frames", split=split)))
    labels = dataset.table("labels", split=split).to_pandas().groupby("frame_id")
    found = {row["frame_id"]: row for row in rows}
    assert sorted(found) == sorted(frames.index) == sorted(pngs)
    for frame_id, row in found.items():
        assert np.array_equal(np.array(row["image"]), np.array(Image.open(io.BytesIO(pngs[frame_id]))))
        assert row["position_m"] == frames.loc[frame_id, "position_m"].tolist()
        own = labels.get_group(frame_id).set_index("crater_id")["ellipse_a_px"].to_dict()
        assert {each["crater_id"]: each["ellipse_a_px"] for each in row["labels"]} == own


def test_shards_are_loaded_and_streamed_by_split(crowded_packed, offline, tmp_path):
    dataset, cache = open_dataset(crowded_packed), str(tmp_path / "cache")
    files = {split: [dataset.store.at(path) for path in dataset.shards(split)] for split in ("train", "val", "test")}
    assert len(files["train"]) > 1
    loaded = offline.load_dataset("parquet", data_files=files, cache_dir=cache)
    for split, rows in loaded.items():
        check_rows(dataset, split, rows)
    # Without a card `datasets` finds the splits by the names of the shards.
    named = offline.load_dataset(str(crowded_packed), cache_dir=cache)
    assert set(named) == {"train", "validation", "test"}
    check_rows(dataset, "val", named["validation"])
    root = shutil.copytree(crowded_packed, tmp_path / "set")
    with Progress(disable=True) as progress:
        write_card(open_dataset(root), None, progress)
    for split in ("train", "val", "test"):
        check_rows(dataset, split, offline.load_dataset(str(root), split=split, cache_dir=cache, streaming=True))
    labels = offline.load_dataset(str(root), "labels", split="mixed", cache_dir=cache)
    assert len(labels) == dataset.info.counts.labels


def test_shards_are_read_by_pandas_polars_and_duckdb(crowded_packed):
    duckdb, polars = pytest.importorskip("duckdb"), pytest.importorskip("polars")
    dataset = open_dataset(crowded_packed)
    pattern = str(dataset.file("shards") / "train-*.parquet")
    frames, labels = (dataset.table(name, split="train").to_pandas() for name in ("frames", "labels"))
    area = (np.pi * labels["radius_px"] ** 2).sum()
    rows = pd.concat([pd.read_parquet(dataset.store.at(path)) for path in dataset.shards("train")])
    assert rows["frame_id"].tolist() == frames["frame_id"].tolist()
    assert sum(np.pi * each["radius_px"] ** 2 for own in rows["labels"] for each in own) == pytest.approx(area)
    found = polars.scan_parquet(pattern).select("frame_id", "labels").explode("labels").unnest("labels").collect()
    assert len(found) == len(labels) and np.pi * (found["radius_px"] ** 2).sum() == pytest.approx(area)
    query = f"select sum(pi() * l.radius_px ** 2) from (select unnest(labels) as l from '{pattern}')"
    assert duckdb.sql(query).fetchall()[0][0] == pytest.approx(area)
    assert duckdb.sql(f"select octet_length(image.bytes) = png_bytes from '{pattern}'").fetchall() == [(True,)] * 10


@pytest.fixture(params=["files", "packed", "split by frame"])
def source(request, crowded, crowded_packed, tmp_path):
    """Datasets with frames as files, with packed frames, and with several splits in one part."""
    if request.param == "split by frame":
        split_dataset(open_dataset(crowded), tmp_path / "mixed", Split("frame", 0.2, 0.2))
        return open_dataset(tmp_path / "mixed")
    return open_dataset(crowded if request.param == "files" else crowded_packed)


def test_an_export_has_splits_with_images_poses_and_labels(source, offline, tmp_path):
    out = tmp_path / "hub"
    with Progress(disable=True) as progress:
        choose = by_selection(SELECTIONS["visible"])
        assert export_hugging_face(source, out, progress, choose=choose, shard_mb=0.1) == source.info.counts.frames
    assert len(list(out.glob("data/train/*.parquet"))) > 1
    loaded = offline.load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"train", "val", "test"}
    pngs = dict(source.pngs(source.table("frames")))
    labels = source.table("labels").to_pandas()
    chosen = []
    for name, rows in loaded.items():
        frames = source.table("frames", split=name).to_pandas().set_index("frame_id")
        assert sorted(rows["frame_id"]) == sorted(frames.index)
        for row in rows:
            frame_id = row["frame_id"]
            assert np.array_equal(np.array(row["image"]), np.array(Image.open(io.BytesIO(pngs[frame_id]))))
            assert row["position_m"] == frames.loc[frame_id, "position_m"].tolist()
            own = labels[labels["frame_id"] == frame_id].set_index("crater_id")
            assert {each["crater_id"]: each["ellipse_a_px"] for each in row["labels"]} == own["ellipse_a_px"].to_dict()
            chosen += [each["chosen"] for each in row["labels"]]
    assert 0 < sum(chosen) < len(chosen) == len(labels)
    test = offline.load_dataset(str(out), split="test", cache_dir=str(tmp_path / "cache"))
    assert test["frame_id"] == loaded["test"]["frame_id"]


def test_the_card_of_frames_in_files_declares_no_split_train(crowded, offline, tmp_path):
    root = shutil.copytree(crowded, tmp_path / "set")
    with Progress(disable=True) as progress:
        write_card(open_dataset(root), None, progress)
    loaded = offline.load_dataset(str(root), cache_dir=str(tmp_path / "cache"))
    assert set(loaded) == {"mixed"} and set(loaded["mixed"]["split"]) == {"train", "val", "test"}
    labels = offline.load_dataset(str(root), "labels", split="mixed", cache_dir=str(tmp_path / "cache"))
    assert len(labels) == open_dataset(crowded).info.counts.labels
    for split in ("train", "test"):
        with pytest.raises(ValueError, match="Unknown split"):
            offline.load_dataset(str(root), split=split, cache_dir=str(tmp_path / "cache"))
