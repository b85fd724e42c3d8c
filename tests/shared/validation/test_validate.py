"""Validation finds damage to a dataset and names file and column."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tests.helpers import in_process

from perilune_shared.cli.main import main
from perilune_shared.dataset import manifest
from perilune_shared.dataset.manifest import count_rows, open_dataset
from perilune_shared.dataset.parts import Part, write_part
from perilune_shared.dataset.schema import OPTIONAL_TABLES, SCHEMA_VERSION, TABLES, complete
from perilune_shared.errors import UserError
from perilune_shared.export.stats import summary
from perilune_shared.storage.store import open_store
from perilune_shared.validation.faults import part_faults
from perilune_shared.validation.validate import validate

MANIFEST = str(Path(sys.executable).parent / "perilune-manifest")


def rewrite(root, table, change, part=0):
    """Apply `change` to one part's rows as a pandas frame."""
    path = sorted((root / "manifest" / table).glob("*.parquet"))[part]
    frame = pq.read_table(path).to_pandas()
    change(frame)
    pq.write_table(complete(table, pa.Table.from_pandas(frame, preserve_index=False)), path)


def put(column, value, row=0):
    def change(frame):
        frame.at[row, column] = value

    return change


DAMAGES = {
    "NaN pose": ("frames", put("position_m", np.array([np.nan, 0, 1])), "position_m"),
    "long quaternion": ("frames", put("rotation_wxyz", np.array([1.0, 0.1, 0, 0])), "rotation_wxyz"),
    "unknown split": ("frames", put("split", "training"), "split"),
    "double frame": ("frames", put("frame_id", "scene-0000/trajectory-0000/000001"), "frame_id"),
    "climbing path": ("frames", put("png_path", "../../etc/passwd"), "png_path"),
    "absolute path": ("frames", put("png_path", "/etc/passwd"), "png_path"),
    "missing file": ("frames", put("png_path", "frames/none.png"), "png_path"),
    "wrong size": ("frames", put("png_bytes", 17), "png_bytes"),
    "wrong hash": ("frames", put("png_sha256", "0" * 64), "png_sha256"),
    "moved ellipse": ("labels", put("ellipse_cx_px", 12.0), "ellipse_cx_px"),
    "grown box": ("labels", put("bbox_x1_px", 500.0), "bbox_x1_px"),
    "negative radius": ("labels", put("radius_px", -1.0), "radius_px"),
    "fraction above one": ("labels", put("visible_fraction", 1.25), "visible_fraction"),
    "unknown crater": ("labels", put("crater_id", 999_999), "crater_id"),
    "unknown frame": ("labels", put("frame_id", "scene-0000/none/000000"), "frame_id"),
    "latitude": ("scenes", put("latitude_deg", 95.0), "latitude_deg"),
    "double crater": ("craters", put("crater_id", 1), "scene_id+crater_id"),
    "infinite depth": ("craters", put("depth_m", np.inf), "depth_m"),
    "more frames planned": ("trajectories", put("n_frames", 9), "n_frames"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_found(quick_detect, name):
    table, change, column = DAMAGES[name]
    rewrite(quick_detect, table, change)
    faults = validate(open_dataset(quick_detect))
    assert any(column in fault.column for fault in faults), faults


def test_a_terrain_in_two_splits_is_found(quick_detect):
    rewrite(quick_detect, "frames", put("split", "val", 2))
    rewrite(quick_detect, "frames", put("split", "test", 3))
    assert any("one split for each terrain" in fault.expected for fault in validate(open_dataset(quick_detect)))


def test_a_flipped_byte_in_any_kind_of_file_is_found(quick_detect):
    rng = np.random.default_rng(1)
    for path in [
        *quick_detect.glob("manifest/*/scene-0000*.parquet"),
        next(quick_detect.rglob("000000.png")),
        next(quick_detect.rglob("000000.exr")),
    ]:
        whole = path.read_bytes()
        spot = len(whole) // 2 if path.suffix != ".parquet" else int(rng.integers(10, len(whole) // 2))
        path.write_bytes(whole[:spot] + bytes([whole[spot] ^ 0x10]) + whole[spot + 1 :])
        if path.suffix != ".parquet":
            assert validate(open_dataset(quick_detect)), path
        path.write_bytes(whole)


@pytest.mark.parametrize("table", [name for name in TABLES if name not in OPTIONAL_TABLES])
def test_a_truncated_part_is_found(quick_detect, table):
    path = sorted((quick_detect / "manifest" / table).glob("*.parquet"))[0]
    path.write_bytes(path.read_bytes()[:-20])
    faults = validate(open_dataset(quick_detect))
    assert any(path.name in fault.file for fault in faults)
    with pytest.raises(UserError, match="complete Parquet file"):
        open_dataset(quick_detect).table(table)


def test_a_missing_part_is_found(quick_detect):
    sorted((quick_detect / "manifest/labels").glob("*.parquet"))[0].unlink()
    assert any(fault.column == "counts.labels" for fault in validate(open_dataset(quick_detect)))


def test_a_link_out_of_the_dataset_is_found(quick_detect):
    frame = next(quick_detect.rglob("000003.png"))
    outside = quick_detect.parent / "outside.png"
    frame.rename(outside)
    frame.symlink_to(outside)
    assert any(fault.column == "png_path" for fault in validate(open_dataset(quick_detect)))


@pytest.mark.parametrize(("key", "columns"), [("meaning", set()), ("unit", {"time_s"})])
def test_a_column_may_have_another_meaning_but_no_other_unit(quick_detect, key, columns):
    """Datasets stay valid when a later version words the meaning of a column differently."""
    path = sorted((quick_detect / "manifest/frames").glob("*.parquet"))[0]
    rows = pq.read_table(path)
    place = rows.schema.get_field_index("time_s")
    field = rows.schema.field(place)
    changed = field.with_metadata({**field.metadata, key.encode(): b"other words"})
    pq.write_table(rows.cast(rows.schema.set(place, changed)), path)
    dataset = open_dataset(quick_detect)
    assert {fault.column for fault in part_faults(dataset, dataset.parts("frames")[0], "frames")} == columns
    assert dataset.table("frames").num_rows == 24


def test_another_schema_version_is_refused(quick_detect):
    path = sorted((quick_detect / "manifest/frames").glob("*.parquet"))[0]
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({"perilune.table": "frames", "perilune.schema_version": "0"}), path)
    with pytest.raises(UserError, match="migrate"):
        Part(open_store(path.parent), path.name, "frames").read()


def test_parts_are_never_rewritten(quick_detect):
    rows = open_dataset(quick_detect).table("scenes")
    with pytest.raises(FileExistsError):
        write_part(quick_detect, "scenes", "all", rows)
    write_part(quick_detect, "scenes", "scene-0009", rows[:1])
    assert count_rows(open_dataset(quick_detect)).scenes == 4


def test_files_contain_units(quick):
    part = sorted((quick / "detect/manifest/craters").glob("*.parquet"))[0]
    schema = pq.read_schema(part)
    assert schema.field("diameter_m").metadata[b"unit"] == b"m" and schema.metadata[b"perilune.table"] == b"craters"


def test_selected_rows_and_columns(quick):
    dataset = open_dataset(quick / "detect")
    one = dataset.table("craters", columns=["diameter_m"], scene_id="scene-0001")
    assert one.column_names == ["diameter_m"] and 0 < one.num_rows < dataset.table("craters").num_rows
    splits = {s: dataset.table("frames", split=s).num_rows for s in ("train", "val", "test")}
    assert splits == {"train": 8, "val": 8, "test": 8}


def test_summary_counts_rows(quick):
    dataset = open_dataset(quick / "nav")
    frame = summary(dataset).set_index("split")
    assert frame["frames"].sum() == 45 and frame.loc["train", "trajectories"] == 3
    assert frame["labels"].sum() == dataset.table("labels").num_rows == dataset.info.counts.labels


def test_every_part_is_opened_once(little, monkeypatch):
    opened = []

    class Counted(manifest.Part):
        def __init__(self, store, path, *arguments):
            opened.append(path)
            super().__init__(store, path, *arguments)

    monkeypatch.setattr(manifest, "Part", Counted)
    dataset = open_dataset(little)
    assert validate(dataset) == []
    assert sorted(opened) == sorted(part for name in TABLES for part in dataset.parts(name))
    # Parts are kept open only during validation; later reads open them again.
    dataset.table("frames")
    assert len(opened) == len(set(opened)) + 1


def test_command_line(quick, quick_detect):
    whole = in_process.call(main, "validate", quick / "nav")
    assert whole.returncode == 0 and "no fault" in whole.stdout
    shown = in_process.call(main, "stats", quick / "nav")
    assert shown.returncode == 0 and "45 frames" in shown.stdout
    next(quick_detect.rglob("000000.png")).write_bytes(b"")
    broken = subprocess.run([MANIFEST, "validate", str(quick_detect)], capture_output=True, text=True)
    assert broken.returncode == 2 and "png_bytes" in broken.stdout
    (quick_detect / "dataset.json").write_text(json.dumps({"schema_version": SCHEMA_VERSION}))
    bad = in_process.call(main, "stats", quick_detect)
    assert bad.returncode == 2 and len(bad.stderr.strip().splitlines()) == 1 and "name" in bad.stderr
