"""Unusual but valid datasets give a correct result; datasets with damaged rows give one line."""

import json
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.progress import Progress
from tests.helpers.drawn_dataset import seal

from perilune_shared.dataset.info_file import write_info
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import Recipe
from perilune_shared.dataset.parts import write_part
from perilune_shared.dataset.schema import complete
from perilune_shared.editing.attach import attach
from perilune_shared.editing.merge import merge
from perilune_shared.editing.pack import pack, unpack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import Limit, subset
from perilune_shared.editing.writer import with_column
from perilune_shared.errors import UserError
from perilune_shared.export.card import write_card
from perilune_shared.export.coco import export_coco
from perilune_shared.storage.files import new_folder
from perilune_shared.validation.validate import validate


def replaced(root, table, rows):
    """Write a table of a drawn dataset again, with a valid index."""
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
def test_frames_under_other_paths_are_copied(victim, tmp_path, change):
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


def test_a_linked_frame_is_copied_as_a_file(victim, tmp_path):
    path = victim / rows_of(victim, "frames")["png_path"][1].as_py()
    path.rename(path.with_name("real.png"))
    path.symlink_to("real.png")
    subset(open_dataset(victim), tmp_path / "out")
    assert validate(open_dataset(tmp_path / "out")) == []


def test_a_plan_and_its_rendered_dataset_have_the_same_scenes(little, tmp_path):
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
def test_inconsistent_tables_lose_no_rows(victim, tmp_path, change, table, damage):
    replaced(victim, table, damage(rows_of(victim, table)))
    with pytest.raises(UserError, match=f"{table}.*validate"):
        CHANGES[change](open_dataset(victim), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_dataset_without_rows_is_refused_in_one_line(victim, tmp_path):
    for table in ("scenes", "trajectories", "frames", "labels", "craters", "boulders"):
        replaced(victim, table, rows_of(victim, table).slice(0, 0))
    with pytest.raises(UserError, match="none"):
        subset(open_dataset(victim), tmp_path / "out", limit=Limit(n_frames=3))
    with pytest.raises(UserError, match="none"):
        write_card(open_dataset(victim), tmp_path / "page.md", Progress())


def test_a_plan_is_not_exported_to_coco(little, tmp_path):
    subset(open_dataset(little), tmp_path / "plan", images="plan")
    with pytest.raises(UserError, match="planned"):
        export_coco(open_dataset(tmp_path / "plan"), tmp_path / "coco", Progress())


def test_attach_refuses_invalid_images(little, tmp_path):
    subset(open_dataset(little), tmp_path / "absent", images="none")
    shutil.copytree(little / "frames", tmp_path / "made" / "frames")
    (tmp_path / "made" / "frames/s000/t000/000001.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match="not a PNG file"):
        attach(open_dataset(tmp_path / "absent"), tmp_path / "made", tmp_path / "out", rehash=True)


@pytest.mark.parametrize("size", [float("inf"), float("nan"), 0, 9000])
def test_shards_have_a_readable_size(little, tmp_path, size):
    with pytest.raises(UserError, match="at most"):
        pack(open_dataset(little), tmp_path / "out", shard_mb=size)


def test_the_working_folder_can_be_the_output(tmp_path, monkeypatch):
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
def test_endless_or_empty_conditions_are_refused(little, tmp_path, where):
    with pytest.raises(UserError, match="--where: got"):
        subset(open_dataset(little), tmp_path / "out", [where])


def test_scenes_over_one_elevation_model_are_one_terrain(victim, tmp_path):
    """The added craters depend on the seed; the terrain of the elevation model does not."""
    scenes = rows_of(victim, "scenes")
    replaced(victim, "scenes", with_column(scenes, "dem_source", ["a.tif sha256:" + "1" * 64] * len(scenes)))
    (fault,) = validate(open_dataset(victim))
    assert fault.column == "split" and "one split for each terrain" in fault.expected
    subset(open_dataset(victim), tmp_path / "same")
    assert open_dataset(tmp_path / "same").info.split_by == "trajectory"
    with pytest.raises(UserError, match="got 1 terrain,"):
        split_dataset(open_dataset(victim), tmp_path / "split", Split(by="scene", val_share=0.5, test_share=0))


def test_a_damaged_table_is_not_copied(drawn, tmp_path):
    """A new index would hide the damage."""
    broken = shutil.copytree(drawn, tmp_path / "broken")
    part = broken / "manifest/labels/all.parquet"
    rows = pq.read_table(part).to_pandas()
    rows.loc[3, "contrast"] = 777.0
    pq.write_table(complete("labels", pa.Table.from_pandas(rows, preserve_index=False)), part)
    dataset, out = open_dataset(broken), tmp_path / "out"
    for act in (
        lambda: subset(dataset, out),
        lambda: split_dataset(dataset, out),
        lambda: pack(dataset, out),
        lambda: merge([open_dataset(drawn), dataset], out),
    ):
        with pytest.raises(UserError, match=r"labels/all\.parquet: SHA-256"):
            act()
    assert not out.exists()


def test_a_trajectory_developed_twice_is_one_trajectory(drawn, tmp_path):
    """It has two recipes: the dataset and the one developed from it. Its frames must not be in different splits."""
    other = shutil.copytree(drawn, tmp_path / "other")
    info = json.loads((other / "dataset.json").read_text())
    (recipe,) = info["recipes"].values()
    recipe["versions"]["perilune_shared"] = "0.0"
    key = Recipe.model_validate(recipe).key
    (other / "dataset.json").write_text(json.dumps({**info, "recipes": {key: recipe}}))
    part = other / "manifest/scenes/all.parquet"
    rows = pq.read_table(part).to_pandas().assign(recipe=key)
    pq.write_table(complete("scenes", pa.Table.from_pandas(rows, preserve_index=False)), part)
    seal(other)
    split_dataset(open_dataset(other), tmp_path / "split", Split(val_share=0.2, test_share=0.2, seed=1))
    merge([open_dataset(drawn), open_dataset(tmp_path / "split")], tmp_path / "m")
    made = open_dataset(tmp_path / "m")
    assert made.info.counts.scenes == 10 and made.info.split_by == "frame" and validate(made) == []
    wrong_info = made.info.model_copy(update={"split_by": "trajectory"})
    write_info(made.store.folder, wrong_info)
    seal(made.store.folder)
    assert "one split for each trajectory" in validate(open_dataset(made.store.folder))[0].expected


@pytest.mark.parametrize("inside", ["", "frames", "new/folder"])
def test_no_dataset_is_written_into_another(drawn, inside):
    before = sorted(drawn.rglob("*"))
    with pytest.raises(UserError, match="a folder outside the dataset"):
        subset(open_dataset(drawn), drawn / inside)
    assert sorted(drawn.rglob("*")) == before


def test_conditions_on_labels_of_a_plan_are_refused(drawn, tmp_path):
    with pytest.raises(UserError, match="a plan has no labels"):
        subset(open_dataset(drawn), tmp_path / "p", ["radius_px > 3"], images="plan")
    subset(open_dataset(drawn), tmp_path / "p", images="plan")
    with pytest.raises(UserError, match="a plan has no labels"):
        subset(open_dataset(tmp_path / "p"), tmp_path / "q", ["depth_m > 3"])
    with pytest.raises(UserError, match="train, val, test"):
        open_dataset(drawn).table("labels", split="tset")
    with pytest.raises(UserError, match="dataset --manifest"):
        list(open_dataset(tmp_path / "p").pngs(open_dataset(drawn).table("frames")))


@pytest.mark.parametrize(("column", "value"), [("split", "test"), ("scene_id", "s001")])
def test_labels_of_another_split_or_scene_than_their_frame_are_faults(column, value, victim):
    rows = rows_of(victim, "labels")
    values = rows[column].to_pylist()
    replaced(victim, "labels", with_column(rows, column, [value, *values[1:]]))
    faults = validate(open_dataset(victim))
    assert faults and all(fault.file.startswith("manifest/labels") for fault in faults)
