"""Conditions and subsets."""

import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import unpack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import Limit, subset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate


def subset_of(source, out, *conditions, **options):
    subset(open_dataset(source), out, conditions, **options)
    made = open_dataset(out)
    assert validate(made) == []
    return made


def test_frames_selected_by_trajectory_scene_and_pose(drawn, tmp_path):
    made = subset_of(drawn, tmp_path / "s", "position_m[2] > 900 and trajectories.seed != 1", "sun_elevation_deg > 5")
    frames = made.table("frames").to_pandas()
    every = open_dataset(drawn).table("frames").to_pandas()
    high = every["position_m"].str[2] > 900
    assert sorted(frames["frame_id"]) == sorted(every[high & (every["scene_id"] != "s001")]["frame_id"])
    assert made.info.counts.scenes == 4 and set(made.table("labels")["frame_id"].to_pylist()) <= set(frames["frame_id"])


def test_labels_selected_by_crater(drawn, tmp_path):
    made = subset_of(drawn, tmp_path / "s", "depth_m / craters.diameter_m >= 0.04", "frame_index < 4 and radius_px > 3")
    whole = open_dataset(drawn)
    assert made.info.counts.frames == 40
    labels = whole.table("labels").to_pandas()
    labels["scene_id"] = labels["frame_id"].str[:4]
    labels["frame_index"] = labels["frame_id"].str[-6:].astype(int)
    labels = labels.merge(whole.table("craters").to_pandas(), on=["scene_id", "crater_id"])
    kept = (labels["depth_m"] >= 0.04 * labels["diameter_m"]) & (labels["frame_index"] < 4) & (labels["radius_px"] > 3)
    assert made.info.counts.labels == kept.sum() > 0


def test_subset_by_number_of_frames(drawn, tmp_path):
    made = subset_of(drawn, tmp_path / "s", limit=Limit(n_frames=19))
    rows = made.table("trajectories").to_pydict()
    assert rows["scene_id"] == ["s000", "s001", "s002"] and rows["n_frames"] == [8, 8, 3]
    assert made.info.counts.frames == 19


def test_subset_by_size(drawn, tmp_path):
    made = subset_of(drawn, tmp_path / "s", "frame_index > 0", limit=Limit(megabytes=0.1))
    n_bytes = sum(made.table("frames", ["png_bytes"])["png_bytes"].to_pylist())
    assert 0.09e6 < n_bytes <= 0.1e6
    assert min(made.table("frames", ["frame_index"])["frame_index"].to_pylist()) == 1


def test_a_plan_keeps_hashes_without_derived_rows(drawn, tmp_path):
    made = subset_of(drawn, tmp_path / "s", images="plan")
    assert made.info.images == "planned" and made.info.counts.craters == made.info.counts.labels == 0
    assert made.table("frames", ["png_sha256"]).num_rows == 40 and made.table("frames")["png_sha256"].null_count == 0


@pytest.mark.parametrize("limit", [Limit(n_frames=0), Limit(megabytes=-1.0), Limit(megabytes=1e-5)])
def test_an_empty_subset_is_refused(drawn, tmp_path, limit):
    with pytest.raises(UserError):
        subset_of(drawn, tmp_path / "s", limit=limit)
    with pytest.raises(UserError, match="none left"):
        subset_of(drawn, tmp_path / "s", "frame_index > 99")
    assert list(tmp_path.iterdir()) == []


def test_editing_a_frame_of_a_subset_leaves_its_source_unchanged(little, tmp_path):
    """Frames are copied; only `link` makes hard links."""
    relative = "frames/s000/t000/000001.png"
    before = (little / relative).read_bytes()
    for k, made in enumerate(
        [
            subset_of(little, tmp_path / "s"),
            split_of(little, tmp_path / "t"),
            merged(little, tmp_path / "m"),
            unpacked(little, tmp_path / "u"),
        ]
    ):
        path = made.file(relative)
        assert path.read_bytes() == before and not path.samefile(little / relative)
        path.write_bytes(b"edited %d" % k)
    assert (little / relative).read_bytes() == before
    linked = subset_of(little, tmp_path / "l", images="link")
    assert (linked.store.folder / relative).samefile(little / relative)


def split_of(source, out):
    split_dataset(open_dataset(source), out, Split(val_share=0.5, test_share=0.0))
    return open_dataset(out)


def merged(source, out):
    merge([open_dataset(source)] * 2, out)
    return open_dataset(out)


def unpacked(source, out):
    unpack(open_dataset(source), out)
    return open_dataset(out)
