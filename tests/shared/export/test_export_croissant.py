"""Croissant metadata, read by mlcroissant, which then reads the records of the local files."""

import io
import json
import shutil
from pathlib import Path

import mlcroissant
import numpy as np
import pytest
from PIL import Image
from tests.helpers import in_process
from typer.testing import CliRunner

from perilune_shared.cli.main import app, main
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.schema import OPTIONAL_TABLES, TABLES, stored
from perilune_shared.editing.writer import new_dataset
from perilune_shared.errors import UserError
from perilune_shared.export.croissant import export_croissant
from perilune_shared.validation.validate import validate


@pytest.fixture(scope="module", params=["crowded", "crowded_packed", "parts"])
def described(request, tmp_path_factory):
    """Datasets of each layout: one part per table, packed frames, one part per scene or trajectory."""
    copy = tmp_path_factory.mktemp(request.param) / "set"
    if request.param == "parts":
        source = open_dataset(request.getfixturevalue("crowded"))
        with new_dataset(copy, source.info) as writer:
            for scene_id in source.scene_ids():
                writer.add_scene(source.scene(scene_id))
            frames = source.table("frames")
            writer.add_images(source, frames, {name: name for name in frames["frame_id"].to_pylist()}, link=True)
    else:
        shutil.copytree(request.getfixturevalue(request.param), copy)
    dataset = open_dataset(copy)
    return dataset, mlcroissant.Dataset(export_croissant(dataset))


def text(value):
    return value.decode() if isinstance(value, bytes) else value


@pytest.mark.parametrize("table", [name for name in TABLES if name not in OPTIONAL_TABLES])
def test_records_are_the_rows(described, table):
    dataset, croissant = described
    assert not croissant.metadata.ctx.issues.errors
    rows = dataset.table(table).to_pylist()
    records = list(croissant.records(table))
    assert len(records) == len(rows)
    names = stored(table, dataset.table(table)).column_names
    assert set(records[0]) == {f"{table}/{name}" for name in names} if records else table == "boulders"
    for record, row in list(zip(records, rows, strict=True))[:: max(1, len(rows) // 50)]:
        for name in names:
            found = text(record[f"{table}/{name}"])
            if isinstance(row[name], list):
                assert np.array_equal(found, row[name]), name
            else:
                assert found == row[name], name


def test_images_are_the_frames(described):
    dataset, croissant = described
    column = "frame_id" if dataset.info.images == "packed" else "png_path"
    found = {text(r[f"images/{column}"]): r["images/image"] for r in croissant.records("images")}
    frames = dataset.table("frames")
    pngs = dict(dataset.pngs(frames))
    names = dict(zip(frames["frame_id"].to_pylist(), frames[column].to_pylist(), strict=True))
    assert len(found) == len(pngs) == 20
    for frame_id in list(pngs)[::7]:
        expected = np.asarray(Image.open(io.BytesIO(pngs[frame_id])).convert("L"))
        assert np.array_equal(np.asarray(found[names[frame_id]].convert("L")), expected)


def test_fields_have_units_and_meanings(described):
    dataset, _ = described
    content = json.loads((dataset.store.folder / "croissant.json").read_text())
    fields = {field["@id"]: field for records in content["recordSet"] for field in records["field"]}
    assert fields["craters/diameter_m"]["description"] == "rim crest to rim crest [m]"
    assert fields["frames/rotation_wxyz"]["arrayShape"] == "4"
    assert content["license"] == "https://spdx.org/licenses/CC0-1.0.html"


def test_the_dataset_stays_valid(described):
    assert validate(described[0]) == []


def test_a_wrong_hash_is_not_overwritten(crowded, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    part = root / "manifest/labels/all.parquet"
    content = part.read_bytes()
    part.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    with pytest.raises(UserError, match="different SHA-256"):
        export_croissant(open_dataset(root))
    assert not (root / "croissant.json").exists()
    with pytest.raises(UserError, match="another folder"):
        export_croissant(open_dataset(root), tmp_path / "croissant.json")


def test_command_line(crowded, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))

    def arguments(*more):
        return ["export", str(root), "--format", *map(str, more)]

    for name in ("coco", "yolo", "tum", "kitti"):
        done = CliRunner().invoke(app, arguments(name, "--out", tmp_path / name, "--split", "val"))
        assert done.exit_code == 0 and f"/{name}: " in done.stdout, done.stdout
        assert any((tmp_path / name).rglob("*.*"))
    assert CliRunner().invoke(app, arguments("croissant")).exit_code == 0 and (root / "croissant.json").is_file()
    for wrong in (["coco"], ["croissant", "--split", "val"], ["yolo", "--split", "training"]):
        assert isinstance(CliRunner().invoke(app, arguments(*wrong)).exception, UserError)
    taken = in_process.call(main, *arguments("tum", "--out", root))
    assert taken.returncode == 2 and len(taken.stderr.strip().splitlines()) == 1, taken.stderr
