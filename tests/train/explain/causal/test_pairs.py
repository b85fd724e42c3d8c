"""Frames with and without craters, on small drawn datasets."""

import numpy as np
import pandas as pd
import pytest
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import read_labels
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.explain.causal.effects import region
from perilune_train.explain.causal.pairs import crater_pairs, read_removed

VISIBLE = SELECTIONS["visible"]


def test_frames_and_craters_of_both_datasets_belong_together(rendered):
    removed = read_removed(str(rendered.without))
    pd.testing.assert_frame_equal(removed, rendered.removed)
    pairs = crater_pairs(open_dataset(rendered.factual), open_dataset(rendered.without), removed, "test", VISIBLE)
    assert pairs.factual.shape == pairs.counterfactual.shape == (12, 96, 96)
    assert pairs.frames["scene_id"].nunique() == 6 and pairs.frames["frame_id"].is_unique
    craters = pairs.craters
    assert set(zip(craters["scene_id"], craters["crater_id"], strict=True)) <= set(
        zip(removed["scene_id"], removed["crater_id"], strict=True)
    )
    assert craters["scene_id"].nunique() == 6 and (craters["depth_ratio"] == 0.15).all()
    np.testing.assert_allclose(craters["sun_elevation_deg"], 30)
    assert pairs.frames["frame_id"].to_numpy()[craters["image"]].tolist() == craters["frame_id"].tolist()
    assert (craters[["bbox_x0_px", "bbox_y0_px"]] >= 0).all(axis=None)
    # Only the removed craters differ.
    changed = pairs.factual != pairs.counterfactual
    inside = np.zeros(changed.shape, bool)
    for _, crater in craters.iterrows():
        inside[crater["image"]] |= region((96, 96), crater)
    assert changed[inside].mean() > 0.5 > changed[~inside].mean()


def test_craters_that_are_nowhere_whole_are_one_error(rendered):
    factual, without = open_dataset(rendered.factual), open_dataset(rendered.without)
    labels = read_labels(factual, ["bbox_x0_px"], "test")
    cut = labels[labels["bbox_x0_px"] < 0][["scene_id", "crater_id"]].drop_duplicates().assign(depth_ratio=0.1)
    unseen = rendered.removed.assign(crater_id=100_000)
    with pytest.raises(UserError, match=rf"craters of split test: got none of {len(unseen)}, expected removed craters"):
        crater_pairs(factual, without, unseen, "test", VISIBLE)
    assert not cut.empty
    both = cut.merge(labels, on=["scene_id", "crater_id"])
    only_cut = both.groupby(["scene_id", "crater_id"]).filter(lambda own: (own["bbox_x0_px"] < 0).all())
    with pytest.raises(UserError, match=r"labelled and whole in a frame"):
        crater_pairs(factual, without, only_cut[cut.columns].drop_duplicates(), "test", VISIBLE)


def test_frames_of_another_dataset_are_refused(rendered, tmp_path):
    more = build_dataset(tmp_path / "more", "detect", splits={"train": 1, "val": 1, "test": 1}, n_frames=3)
    with pytest.raises(UserError, match=r"frames: got 3 frames, 2 of them in .*rendered from"):
        crater_pairs(open_dataset(rendered.factual), open_dataset(more), rendered.removed, "test", VISIBLE)


def test_a_table_of_removed_craters_is_needed(tmp_path):
    dataset = tmp_path / "without"
    with pytest.raises(UserError, match=r"without.removed.parquet: table: got no such file"):
        read_removed(str(dataset))
    path = tmp_path / "without.removed.parquet"
    pd.DataFrame({"scene_id": ["s0"]}).to_parquet(path)
    with pytest.raises(UserError, match=r"scene_id, crater_id, depth_ratio"):
        read_removed(str(dataset))
    path.write_bytes(b"no table")
    with pytest.raises(UserError, match=r"without.removed.parquet: table"):
        read_removed(f"{dataset}/")
    pd.DataFrame({"scene_id": [], "crater_id": [], "depth_ratio": []}).to_parquet(path)
    with pytest.raises(UserError, match=r"rows: got 0, expected removed craters"):
        read_removed(str(dataset))
