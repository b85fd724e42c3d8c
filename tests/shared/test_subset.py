"""Conditions and subsets."""

import numpy as np
import pytest

from perilune_shared.errors import UserError
from perilune_shared.expression import Condition
from perilune_shared.manifest import open_dataset
from perilune_shared.split import split_dataset
from perilune_shared.subset import subset
from perilune_shared.validate import validate

ROWS = {
    ("labels", "radius_px"): np.array([1.0, 5.0, 9.0, np.nan]),
    ("frames", "split"): np.array(["train", "test", "val", "test"], object),
    ("frames", "position_m"): np.arange(12.0).reshape(4, 3),
}


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("radius_px > 4", [0, 1, 1, 0]),
        ("4 < radius_px <= 9", [0, 1, 1, 0]),
        ("not radius_px > 4", [1, 0, 0, 1]),
        ("split == 'test'", [0, 1, 0, 1]),
        ("split in ('val', 'test') and radius_px < 6", [0, 1, 0, 0]),
        ("split not in ['val'] or radius_px == 9", [1, 1, 1, 1]),
        ("position_m[2] > 5 and position_m[0] < 9", [0, 0, 1, 0]),
        ("sqrt(labels.radius_px) * 2 - 1 >= 3.4", [0, 1, 1, 0]),
        ("abs(-radius_px) % 4 == 1", [1, 1, 1, 0]),
    ],
)
def test_conditions(text, wanted):
    assert Condition(text).holds(ROWS, 4).astype(int).tolist() == wanted


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("radius > 4", "radius_px"),
        ("boulders.diameter_m > 1", "table.column"),
        ("labels.diameter_m > 1", "table.column"),
        ("__import__('os').system('touch x')", "columns"),
        ("radius_px.__class__", "table.column"),
        ("(lambda: radius_px)()", "columns"),
        ("[x for x in radius_px]", "columns"),
        ("radius_px", "true or false"),
        ("radius_px > 'a'", "numbers with numbers"),
        ("split > 1", "numbers with numbers"),
        ("position_m > 1", "true or false"),
        ("position_m[7] > 1", "numbers with numbers"),
        ("radius_px and split == 'test'", "conditions"),
        ("1 < 2", "on columns"),
        ("radius_px >", "a condition such as"),
        ("radius_px := 3", "a condition such as"),
        ("radius_px ** 9999 > 1", "columns"),
        ("(" * 500 + "radius_px" + ")" * 500, "a condition such as"),
        ("", "a condition such as"),
    ],
)
def test_what_is_no_condition(text, told):
    with pytest.raises(UserError, match=told):
        Condition(text).holds(ROWS, 4)


def taken(source, out, *conditions, **options):
    subset(open_dataset(source), out, conditions, **options)
    made = open_dataset(out)
    assert validate(made) == []
    return made


def test_frames_by_their_descent_scene_and_pose(drawn, tmp_path):
    made = taken(drawn, tmp_path / "s", "position_m[2] > 900 and trajectories.seed != 1", "sun_elevation_deg > 5")
    frames = made.table("frames").to_pandas()
    every = open_dataset(drawn).table("frames").to_pandas()
    high = every["position_m"].str[2] > 900
    assert sorted(frames["frame_id"]) == sorted(every[high & (every["scene_id"] != "s001")]["frame_id"])
    assert made.info.counts.scenes == 4 and set(made.table("labels")["frame_id"].to_pylist()) <= set(frames["frame_id"])


def test_labels_by_their_crater(drawn, tmp_path):
    made = taken(drawn, tmp_path / "s", "depth_m / craters.diameter_m >= 0.04", "frame_index < 4 and radius_px > 3")
    whole = open_dataset(drawn)
    assert made.info.counts.frames == 40
    labels = whole.table("labels").to_pandas()
    labels["scene_id"] = labels["frame_id"].str[:4]
    labels["frame_index"] = labels["frame_id"].str[-6:].astype(int)
    labels = labels.merge(whole.table("craters").to_pandas(), on=["scene_id", "crater_id"])
    kept = (labels["depth_m"] >= 0.04 * labels["diameter_m"]) & (labels["frame_index"] < 4) & (labels["radius_px"] > 3)
    assert made.info.counts.labels == kept.sum() > 0


def test_so_many_frames(drawn, tmp_path):
    made = taken(drawn, tmp_path / "s", n_frames=19)
    rows = made.table("trajectories").to_pydict()
    assert rows["scene_id"] == ["s000", "s001", "s002"] and rows["n_frames"] == [8, 8, 3]
    assert made.info.counts.frames == 19


def test_so_many_megabytes(drawn, tmp_path):
    made = taken(drawn, tmp_path / "s", "frame_index > 0", megabytes=0.1)
    n_bytes = sum(made.table("frames", ["png_bytes"])["png_bytes"].to_pylist())
    assert 0.09e6 < n_bytes <= 0.1e6
    assert min(made.table("frames", ["frame_index"])["frame_index"].to_pylist()) == 1


def test_a_plan_keeps_hashes_and_leaves_what_follows(drawn, tmp_path):
    made = taken(drawn, tmp_path / "s", images="plan")
    assert made.info.images == "planned" and made.info.counts.craters == made.info.counts.labels == 0
    assert made.table("frames", ["png_sha256"]).num_rows == 40 and made.table("frames")["png_sha256"].null_count == 0


@pytest.mark.parametrize("options", [{"n_frames": 0}, {"megabytes": -1.0}, {"megabytes": 1e-5}])
def test_nothing_left_is_refused(drawn, tmp_path, options):
    with pytest.raises(UserError):
        taken(drawn, tmp_path / "s", **options)
    with pytest.raises(UserError, match="none left"):
        taken(drawn, tmp_path / "s", "frame_index > 99")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("by", ["scene", "trajectory", "frame"])
def test_split(drawn, tmp_path, by):
    source = open_dataset(drawn)
    split_dataset(source, tmp_path / "s", by=by, val_share=0.2, test_share=0.2, seed=5)
    made = open_dataset(tmp_path / "s")
    assert validate(made) == [] and made.info.split_by == ("frame" if by == "frame" else "scene")
    frames = made.table("frames").to_pandas()
    assert frames["split"].value_counts().to_dict() == {"train": 24, "val": 8, "test": 8}
    unchanged = [name for name in source.table("frames").column_names if name != "split"]
    order = {"frame_id": "ascending"}.items()
    before = source.table("frames", unchanged).sort_by(list(order))
    assert made.table("frames", unchanged).sort_by(list(order)).equals(before)
    split_dataset(source, tmp_path / "t", by=by, val_share=0.2, test_share=0.2, seed=6)
    assert not open_dataset(tmp_path / "t").table("frames", ["split"]).equals(made.table("frames", ["split"]))


def test_too_few_to_split(drawn, tmp_path):
    with pytest.raises(UserError, match="5 of scene"):
        split_dataset(open_dataset(drawn), tmp_path / "s", val_share=0.5, test_share=0.4)
    with pytest.raises(UserError, match="shares"):
        split_dataset(open_dataset(drawn), tmp_path / "s", val_share=0.5, test_share=0.5)
