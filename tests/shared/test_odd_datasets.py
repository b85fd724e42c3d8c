"""Datasets that are right but unusual, and such as are damaged in their rows: a right result, or one line."""

import shutil

import pyarrow as pa
import pytest
from rich.progress import Progress

from perilune_shared.attach import attach
from perilune_shared.card import write_card
from perilune_shared.checksums import seal
from perilune_shared.errors import UserError
from perilune_shared.export_coco import export_coco
from perilune_shared.files import new_folder
from perilune_shared.manifest import open_dataset
from perilune_shared.merge import merge
from perilune_shared.pack import pack, unpack
from perilune_shared.parts import write_part
from perilune_shared.rewrite import with_column
from perilune_shared.split import split_dataset
from perilune_shared.subset import subset
from perilune_shared.validate import validate


def replaced(root, table, rows):
    """A table of a drawn dataset written anew, with right checksums."""
    root.joinpath("manifest", table, "all.parquet").unlink()
    write_part(root, table, "all", rows)
    seal(root)


def rows_of(root, table):
    return open_dataset(root).table(table)


CHANGES = {
    "subset": lambda source, out: subset(source, out),
    "merge": lambda source, out: merge([source, source], out),
    "pack": lambda source, out: pack(source, out),
    "unpack": lambda source, out: unpack(source, out),
}


@pytest.mark.parametrize("change", CHANGES)
def test_frames_kept_elsewhere_in_a_dataset_come_along(victim, tmp_path, change):
    frames = rows_of(victim, "frames")
    moved = [f"pictures/{frame_id.replace('/', '_')}.png" for frame_id in frames["frame_id"].to_pylist()]
    (victim / "pictures").mkdir()
    for old, new in zip(frames["png_path"].to_pylist(), moved, strict=True):
        (victim / old).rename(victim / new)
    replaced(victim, "frames", with_column(frames, "png_path", moved))
    source = open_dataset(victim)
    assert validate(source) == []
    CHANGES[change](source, tmp_path / "out")
    assert validate(open_dataset(tmp_path / "out")) == []


def test_a_frame_that_is_a_link_within_the_dataset_comes_as_a_file(victim, tmp_path):
    path = victim / rows_of(victim, "frames")["png_path"][1].as_py()
    path.rename(path.with_name("real.png"))
    path.symlink_to("real.png")
    subset(open_dataset(victim), tmp_path / "out")
    assert validate(open_dataset(tmp_path / "out")) == []


def test_a_plan_and_what_was_rendered_from_it_are_the_same_scenes(little, tmp_path):
    subset(open_dataset(little), tmp_path / "plan", images="plan")
    merge([open_dataset(little), open_dataset(tmp_path / "plan")], tmp_path / "both", images="plan")
    both = open_dataset(tmp_path / "both")
    assert both.info.counts == open_dataset(tmp_path / "plan").info.counts and validate(both) == []


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize(
    "table, damage",
    [
        ("scenes", lambda rows: pa.concat_tables([rows, rows.slice(0, 1)])),
        ("scenes", lambda rows: rows.slice(1)),
        ("trajectories", lambda rows: rows.slice(1)),
        ("trajectories", lambda rows: rows.slice(0, 0)),
    ],
)
def test_no_row_is_lost_of_tables_that_do_not_agree(victim, tmp_path, change, table, damage):
    replaced(victim, table, damage(rows_of(victim, table)))
    with pytest.raises(UserError, match=f"{table}: .*validate"):
        CHANGES[change](open_dataset(victim), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_dataset_without_a_row_is_refused_in_one_line(victim, tmp_path):
    for table in ("scenes", "trajectories", "frames", "labels", "craters", "boulders"):
        replaced(victim, table, rows_of(victim, table).slice(0, 0))
    with pytest.raises(UserError, match="none"):
        subset(open_dataset(victim), tmp_path / "out", n_frames=3)
    with pytest.raises(UserError, match="none"):
        write_card(open_dataset(victim), tmp_path / "page.md", Progress())


def test_a_plan_makes_no_coco_file_without_labels(little, tmp_path):
    subset(open_dataset(little), tmp_path / "plan", images="plan")
    with pytest.raises(UserError, match="planned"):
        export_coco(open_dataset(tmp_path / "plan"), tmp_path / "coco", Progress())


def test_what_is_no_picture_is_not_attached(little, tmp_path):
    subset(open_dataset(little), tmp_path / "absent", images="none")
    shutil.copytree(little / "frames", tmp_path / "made" / "frames")
    (tmp_path / "made" / "frames/s000/t000/000001.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match="not a PNG file"):
        attach(open_dataset(tmp_path / "absent"), tmp_path / "made", tmp_path / "out", rehash=True)


@pytest.mark.parametrize("size", [float("inf"), float("nan"), 0, 9000])
def test_shards_are_of_a_size_that_can_be_read(little, tmp_path, size):
    with pytest.raises(UserError, match="at most"):
        pack(open_dataset(little), tmp_path / "out", shard_mb=size)


def test_the_working_folder_can_be_the_new_one(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with new_folder(type(tmp_path)()) as folder:
        (folder / "file").write_text("new")
    assert (tmp_path / "here" / "file").read_text() == "new"


@pytest.mark.parametrize(
    "where",
    [
        "radius_px > 1 / 0",
        "frame_index > 5 % 0",
        "-" * 1900 + "frame_index < 1",
        "not " * 480 + "(frame_index > 1)",
        "'a' * 99999999999999 == split",
        "split * 99999999999999 == 'a'",
        "'%099999999999d' % 3 == split",
    ],
)
def test_conditions_without_end_or_value_are_refused(little, tmp_path, where):
    with pytest.raises(UserError, match="condition"):
        subset(open_dataset(little), tmp_path / "out", [where])


def test_scenes_over_one_elevation_model_are_one_terrain(victim, tmp_path):
    """Added craters differ with the seed; the ground that the model shows does not."""
    scenes = rows_of(victim, "scenes")
    replaced(victim, "scenes", with_column(scenes, "dem_source", ["a.tif sha256:" + "1" * 64] * len(scenes)))
    (fault,) = validate(open_dataset(victim))
    assert fault.column == "split" and "common terrain" in fault.wanted
    subset(open_dataset(victim), tmp_path / "same")
    assert open_dataset(tmp_path / "same").info.split_by == "trajectory"
    with pytest.raises(UserError, match="1 of scene"):
        split_dataset(open_dataset(victim), tmp_path / "split", by="scene", val_share=0.5, test_share=0)
