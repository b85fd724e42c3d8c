"""A dataset is untrusted: hostile names, paths, poses, labels and frames under a valid index."""

import struct
import zlib

import cv2
import numpy as np
import pyarrow as pa
import pytest
from tests.helpers import hostile_parquet as forged
from tests.helpers.hostile import assert_refused, digest, edit, pack, part_of, put, rewrite, sealed
from tests.sampling import every

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.metadata import Counts
from perilune_shared.dataset.packed import SHARDS as SHARD_SCHEMA
from perilune_shared.editing.writer import new_dataset
from perilune_shared.errors import UserError
from perilune_shared.validation.validate import validate

NAMES = {
    "climbs": "../../canary",
    "absolute": "/etc",
    "with a blank": "a b",
    "a command": "$(touch canary)",
    "another command": "a;id",
    "HTML": "<script>alert(1)</script>",
    "a formula": "=cmd()",
    "an option": "-rf",
    "hidden": ".x",
    "empty": "",
    "of 10 kB": "a" * 10_000,
    "of 65 letters": "a" * 65,
    "of two lines": "a\nb",
    "with a line break at its end": "s000\n",
    "that steers a terminal": "a\x1b[2J",
    "from right to left": "a\u202eb",
    "of another script": "\u0430",
    "with NUL": "a\0b",
    "with a percent sign": "%2e%2e",
    "with a backslash": "..\\x",
    "with quotes": "'a\"",
}


def renamed(root, scene_id):
    """Replace the id of the first scene in all tables."""

    def change(row):
        if row.get("scene_id") == "s000":
            row["scene_id"] = scene_id
        if row.get("frame_id", "").startswith("s000/"):
            row["frame_id"] = scene_id + row["frame_id"][4:]

    for table in ("scenes", "craters", "trajectories", "frames", "labels"):
        rewrite(root, table, lambda rows: [change(row) for row in rows])


@pytest.mark.parametrize("name", every(4, NAMES))
def test_hostile_scene_ids_are_refused(name, victim, capsys, monkeypatch):
    sealed(lambda root: renamed(root, NAMES[name]))(victim)
    assert_refused(victim, "manifest/scenes/all.parquet", "scene_id", capsys, monkeypatch)
    with pytest.raises(UserError, match="_id"):
        open_dataset(victim).table("frames")


@pytest.mark.parametrize("name", every(4, ["climbs", "a command", "of 10 kB", "with NUL"]))
def test_hostile_trajectory_and_frame_ids_are_refused(name, victim, capsys, monkeypatch):
    sealed(put("trajectories", "trajectory_id", NAMES[name]))(victim)
    sealed(put("frames", "frame_id", f"s000/{NAMES[name]}/000000"))(victim)
    assert_refused(victim, "manifest/trajectories/all.parquet", "trajectory_id", capsys, monkeypatch)
    assert_refused(victim, "manifest/frames/all.parquet", "frame_id", capsys, monkeypatch)


@pytest.mark.parametrize("column", ["photometry", "dem_source", "recipe", "content_sha256"])
@pytest.mark.parametrize("name", ["HTML", "a formula", "that steers a terminal"])
def test_hostile_texts_are_refused(column, name, victim, capsys, monkeypatch):
    sealed(put("scenes", column, NAMES[name]))(victim)
    assert_refused(victim, "manifest/scenes/all.parquet", column, capsys, monkeypatch)


PATHS = {
    "absolute": "/etc/passwd",
    "climbing": "../canary/frame.png",
    "climbing later": "frames/../../canary/frame.png",
    "with backslashes": "..\\canary\\frame.png",
    "with NUL": "frames/\0.png",
    "of 10 kB": "a" * 10_000,
    "of 900 letters": "/".join(["a" * 9] * 90),
    "of a long name": "a" * 300,
    "of another script": "frames/\u00e4.png",
    "a URL": "https://example.org/a.png",
    "a file URL": "file:///etc/passwd",
    "a drive": "C:/a.png",
    "the home folder": "~/a.png",
    "a variable": "$HOME/a.png",
    "a pattern": "frames/*.png",
    "the folder itself": ".",
    "empty": "",
    "hidden": "frames/.x.png",
    "an option": "-o",
    "a device": "/dev/zero",
    "HTML": "<img>.png",
}


@pytest.mark.parametrize("name", every(4, PATHS))
def test_hostile_paths_are_refused(name, victim, capsys, monkeypatch):
    sealed(put("frames", "png_path", PATHS[name]))(victim)
    assert_refused(victim, "", "png_path", capsys, monkeypatch)


@pytest.mark.parametrize("path", ["../canary/frame.exr", "/dev/zero", "dataset.json"])
def test_hostile_exr_paths_are_refused(path, victim, capsys, monkeypatch):
    for column, value in (("exr_path", path), ("exr_sha256", "0" * 64), ("exr_bytes", 12)):
        sealed(put("frames", column, value))(victim)
    assert_refused(victim, "", "exr_", capsys, monkeypatch)


NUMBERS = [
    ("frames", "position_m", [np.nan, 0.0, 1.0]),
    ("frames", "position_m", [0.0, np.inf, 1.0]),
    ("frames", "position_m", [0.0, 0.0, 1e300]),
    ("frames", "position_m", [0.0, 0.0, 1e-300]),
    ("frames", "rotation_wxyz", [np.nan] * 4),
    ("frames", "rotation_wxyz", [0.0] * 4),
    ("frames", "rotation_wxyz", [2.0, 0.0, 0.0, 0.0]),
    ("frames", "rotation_wxyz", [1e300] * 4),
    ("frames", "velocity_mps", [-np.inf] * 3),
    ("frames", "sun_direction", [np.nan] * 3),
    ("frames", "time_s", np.nan),
    ("frames", "frame_index", -1),
    ("frames", "frame_index", 2**62),
    ("frames", "width_px", 2**62),
    ("frames", "fx_px", 0.0),
    ("frames", "png_bytes", -1),
    ("frames", "png_bytes", 2**62),
    ("labels", "ellipse_a_px", np.nan),
    ("labels", "ellipse_cx_px", 1e300),
    ("labels", "ellipse_b_px", 0.0),
    ("labels", "visible_fraction", -0.1),
    ("labels", "crater_id", -1),
    ("labels", "crater_id", 2**62),
    ("craters", "x_m", np.inf),
    ("craters", "diameter_m", 0.0),
    ("craters", "diameter_m", 1e300),
    ("craters", "normal_z", np.nan),
    ("craters", "normal_z", 0.0),
    ("craters", "crater_id", 2**62),
    ("scenes", "latitude_deg", 1e300),
    ("scenes", "sun_elevation_deg", np.nan),
    ("scenes", "extent_m", -1.0),
    ("trajectories", "n_frames", 2**62),
    ("trajectories", "duration_s", np.inf),
]


@pytest.mark.parametrize(
    ("table", "column", "value", "distorted"),
    every(3, [(*case, False) for case in NUMBERS] + [(*case, True) for case in NUMBERS[:8]]),
)
def test_hostile_numbers_are_refused(table, column, value, distorted, victim, capsys, monkeypatch):
    # With distortion, ellipses are fitted; without, they are computed.
    if distorted:
        edit(lambda content: content["camera"].update(distortion=[-0.1, 0.01, 0.0, 0.0, 0.0]))(victim)
    sealed(put(table, column, value))(victim)
    expected_column = column if column != "normal_z" else "normal_"
    # The camera is so low that no rim is in front of it.
    expected_column = "ellipse_" if value == [0.0, 0.0, 1e-300] else expected_column
    assert_refused(victim, "", expected_column, capsys, monkeypatch)


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(width, height, bits=8, colour=0, rows=b""):
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


HOSTILE_IMAGES = {
    "60 000 x 60 000": (png(60_000, 60_000), "width_px"),
    "2^32 - 1 wide": (png(2**32 - 1, 1), "width_px"),
    "no size": (png(0, 0), "width_px"),
    "another size": (png(32, 31, rows=bytes(33 * 31)), "width_px"),
    "colour": (png(32, 32, colour=2, rows=bytes(97 * 32)), "png_path"),
    "a palette": (png(32, 32, colour=3), "png_path"),
    "one bit": (png(32, 32, bits=1), "png_path"),
    "a JPEG": (b"\xff\xd8\xff\xe0" + bytes(100), "png_path"),
    "an SVG": (b'<svg onload="alert(1)"/>' + bytes(100), "png_path"),
    "only a signature": (b"\x89PNG\r\n\x1a\n", "png_path"),
    "nothing": (b"", "png_bytes"),
}


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", every(3, HOSTILE_IMAGES))
def test_hostile_frames_are_refused(name, packed, victim, capsys, monkeypatch):
    content, expected_column = HOSTILE_IMAGES[name]
    (victim / "frames/s000/t000/000000.png").write_bytes(content)
    put("frames", "png_bytes", len(content))(victim)
    put("frames", "png_sha256", digest(content))(victim)
    sealed(pack if packed else lambda root: None)(victim)
    assert_refused(victim, "", expected_column, capsys, monkeypatch)


def test_bytes_after_an_image_are_allowed(victim):
    """The manifest has the size and hash of the whole file."""
    path = victim / "frames/s000/t000/000000.png"
    content = path.read_bytes() + b"#!/bin/sh\n"
    path.write_bytes(content)
    put("frames", "png_bytes", len(content))(victim)
    sealed(put("frames", "png_sha256", digest(content)))(victim)
    assert validate(open_dataset(victim)) == []
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape == (32, 32)


def image_of(rows, **change):
    rows[0]["image"] = {**rows[0]["image"], **change}


TRAIN = "shards/train-00000-of-00001.parquet"
TEXT_IMAGE = SHARD_SCHEMA.set(SHARD_SCHEMA.get_field_index("image"), pa.field("image", pa.string()))
SHARDS = {
    "a frame twice": (lambda root: pack(root, lambda rows: rows.append(rows[0])), "frame_id"),
    "a frame less": (lambda root: pack(root, lambda rows: rows.pop()), "frame_id"),
    "an unknown frame": (lambda root: pack(root, lambda rows: rows[0].update(frame_id="s009/t000/000000")), "frame_id"),
    "a frame that climbs": (lambda root: pack(root, lambda rows: rows[0].update(frame_id="../../x")), "frame_id"),
    "an image for another": (
        lambda root: pack(root, lambda rows: image_of(rows, **rows[1]["image"])),
        "png_",
    ),
    "no image": (lambda root: pack(root, lambda rows: image_of(rows, bytes=None)), "png_bytes"),
    "images by a dictionary": (lambda root: pack(root, use_dictionary=["image.bytes"]), "image.bytes"),
    "paths by a dictionary": (lambda root: pack(root, use_dictionary=["image.path"]), "image.path"),
    "images as text": (
        lambda root: pack(root, lambda rows: [row.update(image="a") for row in rows], schema=TEXT_IMAGE),
        "image",
    ),
    "a label of another frame": (
        lambda root: pack(root, lambda rows: rows[0]["labels"].append(rows[1]["labels"][0])),
        "labels",
    ),
    "a label less": (lambda root: pack(root, lambda rows: rows[0]["labels"].pop()), "labels"),
    "another pose": (lambda root: pack(root, lambda rows: rows[0].update(position_m=[0.0, 0.0, 9.0])), "position_m"),
    "a path outside": (lambda root: pack(root, lambda rows: image_of(rows, path="/etc/passwd")), "image.path"),
    "frames of another split": (
        lambda root: [pack(root), (root / TRAIN).rename(root / "shards/test-00000-of-00001.parquet")],
        "split",
    ),
    "one of two shards": (
        lambda root: [pack(root), (root / TRAIN).rename(root / "shards/train-00001-of-00002.parquet")],
        "name",
    ),
    "no shard": (lambda root: [pack(root), (root / TRAIN).unlink()], "frame_id"),
    "a file that is not a shard": (lambda root: [pack(root), (root / TRAIN).write_bytes(b"x")], "content"),
    "a shard of another table": (
        lambda root: [pack(root), (root / TRAIN).write_bytes(part_of(root, "frames").read_bytes())],
        "perilune.table",
    ),
    "packed, and frames that cannot be read": (
        lambda root: [pack(root), part_of(root, "frames").write_bytes(b"PAR1PAR1")],
        "content",
    ),
}


@pytest.mark.parametrize("name", every(3, SHARDS))
def test_hostile_shards_are_refused(name, victim, capsys, monkeypatch):
    damage, expected_column = SHARDS[name]
    sealed(damage)(victim)
    assert_refused(victim, "", expected_column, capsys, monkeypatch)


def rows_of_another_scene(root):
    """Make a part named after one scene that contains rows of another."""
    part_of(root, "scenes").rename(root / "manifest/scenes/s001.parquet")


def false_statistics(root):
    """Change the statistics of row groups so that they state other scenes."""
    path = part_of(root, "scenes")

    def change(footer):
        for group in forged.groups(footer):
            _, statistics = forged.columns(group)[0][12]
            forged.put(statistics, 5, b"s555")
            forged.put(statistics, 6, b"s555")

    forged.forge(path, change)


@pytest.mark.parametrize("damage", [rows_of_another_scene, false_statistics])
def test_rows_in_the_wrong_part_are_found(damage, victim, capsys, monkeypatch):
    sealed(damage)(victim)
    assert_refused(victim, "manifest/scenes", "part", capsys, monkeypatch)


@pytest.mark.parametrize("new", ["../../../canary/x", "..", "a\0"])
def test_frames_are_copied_only_under_plain_names(new, victim):
    dataset = open_dataset(victim)
    frames = dataset.table("frames", scene_id="s000")
    names = dict.fromkeys(frames["frame_id"].to_pylist(), new)
    info = dataset.info.model_copy(update={"counts": Counts()})
    before = sorted(victim.parent.rglob("*"))
    with pytest.raises(UserError, match="path"), new_dataset(victim.parent / "new", info) as writer:
        writer.add_images(dataset, frames, names, link=False)
    assert sorted(victim.parent.rglob("*")) == before
