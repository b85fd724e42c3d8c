"""Poses, inertial logs, cameras and SPICE kernels that ask for memory or time: refused in one line, within limits."""

import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import perilune_train.landing.fly.run  # noqa: F401
from perilune_render.cli.main import main as render
from perilune_train.cli.main import main as train
from tests.hostile.measured import refused
from tests.train.landing.fly.descent_files import options, write_descent

NAMES = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
DOWN = (0.0, 0.0, 800.0, 0.0, 1.0, 0.0, 0.0)
MB = 300


def parquet(path, n_rows, time_s=None, **more):
    """Constant columns in few bytes, as runs of a dictionary."""
    columns = dict.fromkeys(NAMES)
    for name, value in zip(NAMES[1:], DOWN, strict=True):
        columns[name] = pa.DictionaryArray.from_arrays(pa.array(np.zeros(n_rows, np.int8)), pa.array([value]))
    columns["time_s"] = columns["x_m"] if time_s is None else pa.array(time_s)
    table = pa.table({name: value.cast(pa.float64()) for name, value in columns.items()} | more)
    pq.write_table(table.replace_schema_metadata({"frame": "O_L"}), path, compression="zstd")
    return path


def frames(tmp_path, path, naming, memory_mb=MB, **limits):
    arguments = "frames", "--poses", path, "--out", tmp_path / "out", "--preset", "tiny"
    refused(path.name, render, *arguments, naming=naming, memory_mb=memory_mb, **limits)
    assert not (tmp_path / "out").exists()


def test_parquet_that_states_millions_of_rows_in_kilobytes(tmp_path):
    path = parquet(tmp_path / "rows.parquet", 4_000_000)
    assert path.stat().st_size < 900_000
    frames(tmp_path, path, "rows.parquet: rows: got")


def test_parquet_with_long_texts_in_a_dictionary(tmp_path):
    n_rows = 150_000
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(n_rows, np.int8)), pa.array(["x" * 40_000]))
    path = parquet(tmp_path / "texts.parquet", n_rows, np.arange(n_rows) * 1.0, trajectory=texts)
    assert path.stat().st_size < 1_500_000
    frames(tmp_path, path, "trajectory: got a text of 40000 bytes, expected at most 1000")


def test_parquet_with_columns_that_nobody_asked_for(tmp_path):
    more = {f"column_{k}": pa.array(["x" * 1000] * 1000) for k in range(300)}
    path = parquet(tmp_path / "columns.parquet", 1000, np.arange(1000) * 1.0, **more)
    frames(tmp_path, path, "columns.parquet: column: got column_0, expected one of time_s")


def test_text_with_too_many_rows_or_one_endless_line(tmp_path):
    head = "# frame: O_L\n" + ",".join(NAMES) + "\n"
    rows = tmp_path / "rows.csv"
    rows.write_text(head + "0,0,0,8,0,1,0,0\n" * 1_100_000)
    frames(tmp_path, rows, "rows.csv: rows: got more than 1000000", limit_s=240)
    tum = tmp_path / "rows.tum"
    tum.write_text("# frame: O_L\n" + "0 0 0 8 1 0 0 0\n" * 1_100_000)
    frames(tmp_path, tum, "rows.tum: rows: got more than 1000000", limit_s=240)
    line = tmp_path / "line.csv"
    line.write_text(head + "1" * 100_000_000)
    frames(tmp_path, line, "line.csv:3: line: got more than 65536 bytes")
    comments = tmp_path / "comments.csv"
    comments.write_text("# frame: O_L\n" * 1_000_000)
    frames(tmp_path, comments, "comments.csv: table: got no line")


def test_a_million_poses_whose_last_line_is_wrong_are_read_within_limits(tmp_path):
    path = tmp_path / "long.csv"
    rows = "".join(f"{k},0,0,800,0,1,0,0\n" for k in range(999_999))
    path.write_text("# frame: O_L\n" + ",".join(NAMES) + "\n" + rows + "5,0,0,800,0,1,0,0\n")
    frames(tmp_path, path, "long.csv:1000002: time_s: got 5 after 999998", memory_mb=500, limit_s=240)


def test_pipes_as_files(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    frames(tmp_path, tmp_path / "pipe.csv", "a pipe or a device", limit_s=20)
    os.mkfifo(tmp_path / "camera.yaml")
    arguments = (
        "frames",
        "--poses",
        tmp_path / "none.csv",
        "--camera",
        tmp_path / "camera.yaml",
        "--out",
        tmp_path / "o",
    )
    refused("camera", render, *arguments, naming="camera.yaml: camera: got no such file", memory_mb=MB, limit_s=20)


def test_meta_kernels_that_name_pipes_devices_and_many_files(tmp_path):
    pytest.importorskip("spiceypy")
    os.mkfifo(tmp_path / "pipe.bsp")
    options = "--spacecraft", "-99", "--camera-frame", "A", "--start", "2026-01-01", "--end", "2026-01-02"
    for name, listed, naming in (
        ("pipe", "'pipe.bsp'", "pipe.bsp: a pipe or a device"),
        ("device", "'/dev/zero'", "/dev/zero: a pipe or a device"),
        ("symbols", "'$A/pipe.bsp'", "pipe.bsp: a pipe or a device"),
        ("itself", "'itself.tm'", "the meta-kernel itself.tm"),
        ("many", ", ".join(["'pipe.bsp'"] * 2000), "2000 texts, expected at most 1000"),
    ):
        symbols = "PATH_VALUES = ( '.' )\nPATH_SYMBOLS = ( 'A' )\n"
        path = tmp_path / f"{name}.tm"
        path.write_text(f"KPL/MK\n\\begindata\n{symbols}KERNELS_TO_LOAD = ( {listed} )\n".replace(", ", ",\n"))
        arguments = "spice", "--kernels", path, *options, "--frames", "2", "--out", tmp_path / "poses.csv"
        refused(name, render, *arguments, naming=naming, folder=tmp_path, memory_mb=MB, limit_s=30)
    assert not (tmp_path / "poses.csv").exists()


CAMERAS = {
    "long.yaml": ("K: [" + "1, " * 60_000 + "1]", "at most 100000"),
    "deep.yaml": ("K: " + "[" * 30_000, "camera.yaml"),
    "aliases.yaml": ("a: &a [1]\nK: [*a, *a]\n", "alias or anchor"),
    "huge.yaml": (json.dumps({"K": [1e308] * 9, "D": [], "image_size": [1, 1]}), "k: got"),
    "digits.yaml": ("K: [" + "9" * 5000 + ", 0, 0, 0, 1, 0, 0, 0, 1]\nimage_size: [4, 4]\n", "camera.yaml"),
    "wide.yaml": (
        json.dumps({"K": [100, 0, 5, 0, 100, 5, 0, 0, 1], "D": [0, 0, 0, 0, 0], "image_size": [10**9, 10**9]}),
        "image size",
    ),
    "fisheye.yaml": (
        json.dumps(
            {
                "K": [1e-3, 0, 5, 0, 1e-3, 5, 0, 0, 1],
                "D": [1e300] * 4,
                "distortion_model": "equidistant",
                "image_size": [100_000, 100_000],
            }
        ),
        "distortion_model equidistant",
    ),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_that_ask_for_memory_or_time(tmp_path, name):
    text, naming = CAMERAS[name]
    folder = write_descent(tmp_path / "descent")
    (folder / "camera.yaml").write_text(text)
    refused(name, train, "navigate", "fly", *options(folder), naming=naming, folder=tmp_path, memory_mb=MB, limit_s=20)


def test_inertial_logs_that_ask_for_memory(tmp_path):
    folder = write_descent(tmp_path / "descent")
    (folder / "imu.csv").write_text("time_s," + "x" * 200_000)
    refused("line", train, "navigate", "fly", *options(folder), naming="imu.csv:1: line", folder=tmp_path, memory_mb=MB)
    (folder / "imu.csv").unlink()
    os.mkfifo(folder / "imu.csv")
    refused(
        "pipe", train, "navigate", "fly", *options(folder), naming="a pipe or a device", folder=tmp_path, limit_s=20
    )
    (folder / "imu.csv").unlink()
    names = [
        "time_s",
        "interval_s",
        *(f"angular_rate_{a}_radps" for a in "xyz"),
        *(f"specific_force_{a}_mps2" for a in "xyz"),
    ]
    zeros = pa.array(np.zeros(8_000_000))
    pq.write_table(pa.table(dict.fromkeys(names, zeros)), folder / "imu.csv", compression="zstd")
    refused("rows", train, "navigate", "fly", *options(folder), naming="rows: got", folder=tmp_path, memory_mb=MB)
