"""Packing, unpacking, migration, diff and attach."""

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers.hostile import rewrite

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.schema import MAY_BE_ABSENT, OPTIONAL_TABLES, TABLES
from perilune_shared.editing.attach import attach
from perilune_shared.editing.diff import differences
from perilune_shared.editing.migrate import migrate
from perilune_shared.editing.pack import pack, unpack
from perilune_shared.editing.split import Split, split_dataset
from perilune_shared.editing.subset import subset
from perilune_shared.errors import UserError
from perilune_shared.export.croissant import metadata_of
from perilune_shared.storage import footers
from perilune_shared.validation.validate import validate

OLD = Path(__file__).parents[1] / "old"


@pytest.fixture(scope="module")
def packed(drawn, tmp_path_factory):
    out = tmp_path_factory.mktemp("packed") / "p"
    pack(open_dataset(drawn), out, shard_mb=0.1)
    return out


def test_unpacking_restores_the_dataset(drawn, packed, tmp_path):
    source, made = open_dataset(drawn), open_dataset(packed)
    assert validate(made) == [] and made.info.images == "packed" and len(made.shards()) > 1
    assert not (packed / "frames").exists() and len(list(packed.rglob("*.parquet"))) == 7 + len(made.shards())
    unpack(made, tmp_path / "u")
    again = open_dataset(tmp_path / "u")
    assert validate(again) == []
    assert [each.column for each in differences(source, again)] == ["history"]
    for path in source.table("frames", ["png_path"])["png_path"].to_pylist():
        assert again.file(path).read_bytes() == source.file(path).read_bytes()


def test_large_tables_become_several_readable_parts(little, tmp_path, monkeypatch):
    source = open_dataset(little)
    assert source.info.counts.craters == 600
    pack(source, tmp_path / "p", max_rows=100, max_frames=2)
    original = footers.DATASET_LIMITS
    monkeypatch.setattr(footers, "DATASET_LIMITS", footers.FooterLimits(rows=100))
    with pytest.raises(UserError, match="rows"):
        source.table("craters")
    made = open_dataset(tmp_path / "p")
    assert validate(made) == []
    assert len(made.parts("craters")) == 6 and len(made.parts("labels")) == 1 and len(made.shards()) == 4
    assert made.parts("craters")[:2] == ["manifest/craters/all.parquet", "manifest/craters/all.0001.parquet"]
    monkeypatch.setattr(footers, "DATASET_LIMITS", original)
    assert made.table("craters").equals(source.table("craters"))
    for scene_id in source.scene_ids():
        assert made.table("craters", scene_id=scene_id).equals(source.table("craters", scene_id=scene_id))
    assert [each.column for each in differences(source, made)] == ["history"]


def test_files_without_optional_columns_read_as_null(little, tmp_path, monkeypatch):
    """A column that was added later is null in older files, and every tool writes it (MAY_BE_ABSENT in schema.py)."""
    later = pa.field("later_share", pa.float64(), metadata={"unit": "", "meaning": "a later column"})
    schema = TABLES["frames"].append(later)
    monkeypatch.setitem(TABLES, "frames", schema)
    with pytest.raises(UserError, match="no later_share"):
        open_dataset(little).table("frames")
    monkeypatch.setitem(MAY_BE_ABSENT, "frames", (*MAY_BE_ABSENT.get("frames", ()), "later_share"))
    source = open_dataset(little)
    assert validate(source) == []
    frames = source.table("frames", ["later_share", "frame_id"], split="val")
    assert frames["later_share"].null_count == len(frames) == 3
    assert source.table("frames", ["later_share"]).num_rows == 6
    subset(source, tmp_path / "s", images="none")
    part = open_dataset(tmp_path / "s").parts("frames")[0]
    assert "later_share" in pq.read_schema(tmp_path / "s" / part).names
    assert metadata_of(open_dataset(tmp_path / "s"))["recordSet"][4]["field"][-1]["name"] == "later_share"
    assert metadata_of(source)["recordSet"][4]["field"][-1]["name"] != "later_share"


def test_packed_frames_are_read_by_frame_id(drawn, packed):
    source, made = open_dataset(drawn), open_dataset(packed)
    frames = made.table("frames", split="test")
    found = dict(made.pngs(frames))
    assert found == dict(source.pngs(source.table("frames", split="test"))) and len(found) == 8


def test_one_trajectory_of_a_packed_table(drawn, packed):
    source, made = open_dataset(drawn), open_dataset(packed)
    for name in ("frames", "labels", "trajectories"):
        theirs = source.table(name, scene_id="s003", trajectory_id="t003")
        assert len(theirs) and made.table(name, scene_id="s003", trajectory_id="t003").equals(theirs)
    assert made.table("craters", ["x_m"], scene_id="s002").equals(source.table("craters", ["x_m"], scene_id="s002"))


def test_a_subset_of_a_packed_dataset(packed, tmp_path):
    subset(open_dataset(packed), tmp_path / "s", ["split == 'val'"])
    made = open_dataset(tmp_path / "s")
    assert validate(made) == [] and made.info.images == "files" and made.info.counts.frames == 8


def test_the_metadata_of_a_shard_declares_an_image_column(packed):
    schema = pq.read_schema(packed / open_dataset(packed).shards()[0])
    features = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    of_frames = [name for name in TABLES["frames"].names if name != "camera"]
    assert features["image"] == {"_type": "Image"} and schema.names == [*of_frames, "image", "labels"]


def test_images_without_poses_and_labels_are_refused(packed, tmp_path):
    """The packed form of earlier versions."""
    root = shutil.copytree(packed, tmp_path / "p")
    (root / "shards").rename(root / "images")
    with pytest.raises(UserError, match=r"dataset.json: images: got frames in images/\*.parquet, expected .*unpack"):
        open_dataset(root)


@pytest.mark.parametrize("version", ["1", "2"])
def test_old_datasets_are_migrated(version, tmp_path):
    """Each dataset was rendered by a release of its schema version, then reduced to the craters with labels."""
    with pytest.raises(UserError, match="migrate"):
        open_dataset(OLD / version)
    migrate(OLD / version, tmp_path / "new")
    made = open_dataset(tmp_path / "new")
    assert validate(made) == []
    assert made.info.history == (f"migrated from schema version {version}",)
    assert made.info.recipe().config["camera"]["width_px"] == 64 and made.info.recipe().seed == 20240117
    old = pq.read_table(next((OLD / version / "manifest/labels").glob("*.parquet")))
    assert made.table("labels", ["ellipse_cx_px"])["ellipse_cx_px"].equals(old["ellipse_cx_px"].cast(pa.float32()))
    assert made.table("labels")["contrast"].null_count == len(old)
    origins = set(made.table("craters")["origin"].to_pylist())
    assert origins == {"primary"} if version == "1" else "primary" in origins
    with pytest.raises(UserError, match="older version"):
        migrate(tmp_path / "new", tmp_path / "newer")


def test_a_dataset_of_version_3_is_migrated(tmp_path):
    migrate(OLD / "3", tmp_path / "new")
    made, old = open_dataset(tmp_path / "new"), OLD / "3/manifest"
    assert validate(made) == [] and made.info.history == ("migrated from schema version 3",)
    for name in set(TABLES) - set(OPTIONAL_TABLES):
        before = pq.read_table(old / name / "all.parquet")
        after = made.table(name, before.column_names)
        assert after.equals(before.replace_schema_metadata().cast(after.schema)), name
    labels = made.table("labels", ["frame_id", "scene_id", "split"]).to_pylist()
    split_of = {row["frame_id"]: row["split"] for row in made.table("frames").to_pylist()}
    assert {row["split"] for row in labels} == {"train", "val"}
    assert all(row["split"] == split_of[row["frame_id"]] for row in labels)
    assert all(row["frame_id"].startswith(f"{row['scene_id']}/") for row in labels)
    for path in old.parent.glob("frames/*/*/*.png"):
        assert (tmp_path / "new" / path.relative_to(old.parent)).read_bytes() == path.read_bytes()


def test_packed_frames_of_version_3_are_refused(tmp_path):
    old = shutil.copytree(OLD / "3", tmp_path / "old")
    text = (old / "dataset.json").read_text()
    (old / "dataset.json").write_text(text.replace('"images": "files"', '"images": "packed"'))
    with pytest.raises(UserError, match=r"images: got packed, expected .*unpack"):
        migrate(old, tmp_path / "new")


def test_damaged_old_datasets_are_refused(tmp_path):
    old = shutil.copytree(OLD / "2", tmp_path / "old")
    info = json.loads((old / "dataset.json").read_text())

    def assert_refused(match, **changes):
        (old / "dataset.json").write_text(json.dumps({**info, **changes}))
        with pytest.raises(UserError, match=match):
            migrate(old, tmp_path / "new")
        assert not (tmp_path / "new").exists()

    assert_refused("schema_version", schema_version="0")
    assert_refused("schema_version", schema_version=["2"])
    assert_refused("complete", complete=False)
    assert_refused("config", config=3)
    assert_refused("camera", camera={})
    (old / "dataset.json").write_text(json.dumps({k: v for k, v in info.items() if k != "seed"}))
    with pytest.raises(UserError, match="seed"):
        migrate(old, tmp_path / "new")
    (old / "dataset.json").write_text(json.dumps(info))
    part = next((old / "manifest/labels").glob("*.parquet"))
    part.write_bytes(part.read_bytes()[:-30])
    with pytest.raises(UserError, match="complete Parquet"):
        migrate(old, tmp_path / "new")


def test_diff_names_the_differences(drawn, tmp_path):
    source = open_dataset(drawn)
    assert differences(source, source) == []
    subset(source, tmp_path / "s", ["split != 'val'", "radius_px > 4"])
    split_dataset(open_dataset(tmp_path / "s"), tmp_path / "t", Split(by="frame"))
    found = {(each.table, each.column): each for each in differences(source, open_dataset(tmp_path / "t"))}
    assert found["scenes", ""].rows == 1 and found["scenes", ""].second == "-"
    n_small = source.table("labels", ["radius_px"], split="train").to_pandas()["radius_px"].le(4).sum()
    n_small += source.table("labels", ["radius_px"], split="test").to_pandas()["radius_px"].le(4).sum()
    assert found["labels", ""].rows == n_small
    assert found["frames", "split"].rows > 0 and found["dataset.json", "split_by"].second == "frame"
    assert ("frames", "position_m") not in found and ("craters", "") not in found


def test_repeated_rows_are_a_difference(little, tmp_path):
    """Rows with equal keys: once with equal content, once with different content."""
    twice = shutil.copytree(little, tmp_path / "twice")
    rewrite(twice, "labels", lambda rows: rows.append(dict(rows[2])))
    found = differences(open_dataset(little), open_dataset(twice))
    assert [(each.table, each.rows, each.first, each.second) for each in found] == [("labels", 1, "-", "present")]
    other = shutil.copytree(twice, tmp_path / "other")
    rewrite(other, "labels", lambda rows: rows[-1].update(radius_px=rows[-1]["radius_px"] + 1))
    found = differences(open_dataset(twice), open_dataset(other))
    assert [(each.table, each.column, each.rows) for each in found] == [("labels", "radius_px", 1)]
    assert differences(open_dataset(other), open_dataset(other)) == []


def test_attach_combines_manifest_and_frames(drawn, tmp_path):
    source = open_dataset(drawn)
    subset(source, tmp_path / "m", ["split == 'val'"], images="none")
    manifest = open_dataset(tmp_path / "m")
    attach(manifest, drawn, tmp_path / "whole")
    whole = open_dataset(tmp_path / "whole")
    assert validate(whole) == [] and whole.info.images == "files"
    assert whole.table("frames").equals(source.table("frames", split="val"))
    other = shutil.copytree(drawn / "frames", tmp_path / "other/frames").parent
    path = other / whole.table("frames")["png_path"][3].as_py()
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(UserError, match="--rehash"):
        attach(manifest, other, tmp_path / "w")
    attach(manifest, other, tmp_path / "w", rehash=True)
    assert validate(open_dataset(tmp_path / "w")) == []
    path.unlink()
    with pytest.raises(UserError, match=path.name):
        attach(manifest, other, tmp_path / "w2")
    with pytest.raises(UserError, match="images"):
        attach(whole, drawn, tmp_path / "w2")
    assert not (tmp_path / "w2").exists()
