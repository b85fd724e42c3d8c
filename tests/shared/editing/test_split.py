"""Splits by content: terrain, flight and pose, independent of names."""

import shutil

import pytest
from tests.helpers.drawn_dataset import build_dataset, seal
from tests.helpers.hostile import edit, rewrite

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.merge import merge
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate


@pytest.mark.parametrize("by", ["scene", "trajectory", "frame"])
def test_split(drawn, tmp_path, by):
    source = open_dataset(drawn)
    split_dataset(source, tmp_path / "s", Split(by=by, val_share=0.2, test_share=0.2, seed=5))
    made = open_dataset(tmp_path / "s")
    assert validate(made) == [] and made.info.split_by == ("frame" if by == "frame" else "scene")
    frames = made.table("frames").to_pandas()
    assert frames["split"].value_counts().to_dict() == {"train": 24, "val": 8, "test": 8}
    unchanged = [name for name in source.table("frames").column_names if name != "split"]
    order = {"frame_id": "ascending"}.items()
    before = source.table("frames", unchanged).sort_by(list(order))
    assert made.table("frames", unchanged).sort_by(list(order)).equals(before)
    split_dataset(source, tmp_path / "t", Split(by=by, val_share=0.2, test_share=0.2, seed=6))
    assert not open_dataset(tmp_path / "t").table("frames", ["split"]).equals(made.table("frames", ["split"]))


def test_too_few_units_are_refused(drawn, tmp_path):
    with pytest.raises(UserError, match="5 terrains"):
        split_dataset(open_dataset(drawn), tmp_path / "s", Split(val_share=0.5, test_share=0.4))
    with pytest.raises(UserError, match="shares"):
        split_dataset(open_dataset(drawn), tmp_path / "s", Split(val_share=0.5, test_share=0.5))


@pytest.mark.parametrize("by", ["trajectory", "frame"])
def test_a_flight_under_two_names_stays_in_one_split(tmp_path, by):
    """A flight that was developed again has another name, and may have another seed in a manual plan."""
    root = build_dataset(tmp_path / "d", "nav", splits={"train": 6}, scenes=2, n_frames=4, craters=40, side_px=32)
    for table in ("trajectories", "frames"):
        rewrite(root, table, lambda rows: rows.extend([renamed(row) for row in rows]))
    edit(lambda content: content["counts"].update(trajectories=12, frames=48, labels=0))(root)
    rewrite(root, "labels", lambda rows: rows.clear())
    seal(root)
    for seed in range(4):
        split_dataset(open_dataset(root), tmp_path / f"{seed}", Split(by, 0.2, 0.2, seed=seed), images="none")
        made = open_dataset(tmp_path / f"{seed}")
        frames = made.table("frames").to_pandas()
        flight = frames["trajectory_id"].str.removesuffix("b") + frames["scene_id"]
        flight += frames["frame_id"].str[-7:] if by == "frame" else ""
        assert frames.groupby(flight)["split"].nunique().max() == 1 and frames["split"].nunique() == 3
        assert validate(made) == [] and made.info.split_by == ("trajectory" if by == "trajectory" else "frame")


def renamed(row):
    row = {**row, "trajectory_id": row["trajectory_id"] + "b"}
    if "seed" in row:
        # Half of the flights keep their seed; the others are recognised only by their poses.
        row["seed"] += 100 * (row["seed"] % 2)
    if "frame_id" in row:
        row["frame_id"] = f"{row['scene_id']}/{row['trajectory_id']}/{row['frame_index']:06d}"
        row["png_path"] = f"frames/{row['frame_id']}.png"
    return row


def test_one_terrain_under_two_names_stays_in_one_split(drawn, tmp_path):
    sources = []
    for k in range(2):
        root = shutil.copytree(drawn, tmp_path / f"{k}")
        rewrite(root, "scenes", lambda rows, k=k: [row.update(sun_azimuth_deg=10.0 + k) for row in rows])
        seal(root)
        sources.append(open_dataset(root))
    merge(sources, tmp_path / "m", images="none")
    for seed in range(4):
        split_dataset(open_dataset(tmp_path / "m"), tmp_path / f"s{seed}", Split("scene", 0.2, 0.2, seed=seed))
        frames = open_dataset(tmp_path / f"s{seed}").table("frames", ["scene_id", "split"]).to_pandas()
        assert frames["scene_id"].nunique() == 10
        assert frames.groupby(frames["scene_id"].str[:4])["split"].nunique().max() == 1
