"""Clocks of a descent's files, and logs of EuRoC and TUM-VI as they come."""

import json

import numpy as np
import pandas as pd
import pytest
from tests.train.landing.fly.descent_files import (
    DOWN_WXYZ,
    START_M,
    TIMES_S,
    VELOCITY_MPS,
    write_descent,
)

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_train.landing.fly.run import DescentFiles, read_descent

UNIX_NS = 1_403_715_524_907_143_168
IMU = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
TRUTH = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [],"
    " v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
)


@pytest.fixture
def folder(tmp_path):
    return write_descent(tmp_path / "descent")


def read(folder, frames="frames", imu="imu.csv", ranges="ranges.csv", truth="truth.csv", camera="camera.yaml"):
    others = [None if name is None else folder / name for name in (ranges, truth)]
    needed = (folder / name for name in (frames, camera, "catalogue.csv", imu, "prior.yaml"))
    return read_descent(DescentFiles(*needed, *others))


def change(path, column, function):
    table = pd.read_csv(path)
    table[column] = function(table[column])
    table.to_csv(path, index=False)


def to_ns(time_s, start_ns=UNIX_NS):
    return [start_ns + round(1e9 * float(value)) for value in time_s]


@pytest.mark.parametrize(
    ("file", "function", "words"),
    [
        (
            "imu.csv",
            lambda t: (t * 1e9).round(),
            ["imu.csv", "steps of 5e+07 ", "0.05 s", "nanoseconds: divide by 1e+09"],
        ),
        ("imu.csv", lambda t: t * 1e6, ["imu.csv", "microseconds"]),
        ("imu.csv", lambda t: t * 1e3, ["imu.csv", "milliseconds: divide by 1000"]),
        ("imu.csv", lambda t: pd.Series(to_ns(t)), ["imu.csv:2: time_s", "these may be nanoseconds"]),
        (
            "imu.csv",
            lambda t: t + 1403715524.9,
            ["imu.csv: time_s: got 1403715529.85 to ", "frames, 10 to 12 s", "the starts differ by 1403715519.85 s"],
        ),
        ("frames/frames.csv", lambda t: (t * 1e9).round(), ["imu.csv", "10000000000 to 12000000000 s", "nanoseconds"]),
        ("frames/frames.csv", lambda t: ((t - 10) * 1e9).round(), ["the times of the frames may be", "seconds"]),
        ("frames/frames.csv", lambda t: pd.Series(to_ns(t)), ["frames.csv:2: time_s", "these may be nanoseconds"]),
        ("frames/frames.csv", lambda t: t - 10.0, ["imu.csv: time_s: got 4.95 to", "frames, 0 to 2 s"]),
        ("ranges.csv", lambda t: t + 1e6, ["ranges.csv: time_s: got 1000005 to 1000011.5 s", "10 to 12 s"]),
        ("ranges.csv", lambda t: (t - 5) * 1e9, ["ranges.csv: time_s: got 0 to", "nanoseconds"]),
        ("ranges.csv", lambda t: pd.Series(to_ns(t)), ["ranges.csv:2: time_s", "nanoseconds"]),
    ],
)
def test_another_clock_or_unit_of_time_is_an_error(folder, file, function, words):
    change(folder / file, "time_s", function)
    with pytest.raises(UserError) as raised:
        read(folder, truth=None)
    for word in words:
        assert word in str(raised.value)


def test_a_log_that_begins_long_before_and_ends_long_after_the_frames_is_read(folder):
    imu = pd.read_csv(folder / "imu.csv")
    step = imu["interval_s"][0]
    before, after = (imu.iloc[[0] * 4000].copy() for _ in range(2))
    before["time_s"], after["time_s"] = (
        5 - step * np.arange(4000, 0, -1),
        imu["time_s"].max() + step * np.arange(1, 4001),
    )
    pd.concat([before, imu, after]).to_csv(folder / "imu.csv", index=False)
    assert len(read(folder).instruments.inertial) == len(imu) + 8000


def test_comments_spaces_and_commas_at_the_end_of_lines_are_read(folder):
    plain = read(folder)
    for name in ("imu.csv", "ranges.csv", "frames/frames.csv", "truth.csv"):
        head, *rows = (folder / name).read_text().splitlines()
        lines = [
            "# made by hand",
            head.replace(",", " , ") + ",",
            rows[0] + ",",
            "# a remark",
            "",
            *(f"{row}," for row in rows[1:]),
        ]
        (folder / name).write_text("\r\n".join(lines))
    found = read(folder)
    assert np.array_equal(found.frames.time_s, plain.frames.time_s)
    assert np.array_equal(
        found.instruments.inertial.specific_force_mps2, plain.instruments.inertial.specific_force_mps2
    )
    assert np.array_equal(found.instruments.range_m, plain.instruments.range_m)
    assert np.array_equal(found.truth.position_m, plain.truth.position_m)


def write_euroc(folder, header=""):
    """The files of a descent as EuRoC's, with the camera in mav0/cam0; samples are at single times."""
    (folder / "mav0/cam0").mkdir(parents=True)
    (folder / "mav0/cam0/data").symlink_to(folder / "frames")
    names = pd.read_csv(folder / "frames/frames.csv")["file"]
    stamps = to_ns(TIMES_S)
    rows = [f"{stamp},{name}" for stamp, name in zip(stamps, names, strict=True)]
    (folder / "mav0/cam0/data.csv").write_text("\n".join(["#timestamp [ns],filename", *rows]))
    ends = np.arange(5, 12.5, 0.05)
    values = np.column_stack([np.sin(ends)] * 3 + [ends, ends**2, 1.6 + 0 * ends])
    lines = [",".join([str(stamp), *map(repr, row)]) for stamp, row in zip(to_ns(ends), values.tolist(), strict=True)]
    (folder / "imu.txt").write_text("\n".join([header or IMU, *lines]))
    times = np.arange(9, 13.5, 0.3)
    place = START_M + VELOCITY_MPS * (times[:, None] - TIMES_S[0])
    turn = np.tile([1.0, 0, 0, 0], (len(times), 1))
    lines = [
        ",".join([str(stamp), *map(repr, row)])
        for stamp, row in zip(to_ns(times), np.hstack([place, turn, place]).tolist(), strict=True)
    ]
    (folder / "mav0/truth.csv").write_text("\n".join([TRUTH, *lines]))
    sensor = {
        "T_BS": {"cols": 4, "rows": 4, "data": np.diag([1.0, -1, -1, 1]).ravel().tolist()},
        "resolution": [64, 64],
        "camera_model": "pinhole",
        "intrinsics": [70.0, 70.0, 31.5, 31.5],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [0, 0, 0, 0],
    }
    (folder / "sensor.yaml").write_text("#camera\n" + "".join(f"{k}: {json.dumps(v)}\n" for k, v in sensor.items()))
    return ends, values


@pytest.mark.parametrize("header", ["", IMU[1:], "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"])
def test_logs_of_euroc_are_read_as_they_come(folder, header):
    ends, values = write_euroc(folder, header)
    found = read(folder, "mav0/cam0", "imu.txt", None, "mav0/truth.csv", "sensor.yaml")
    start_s = UNIX_NS / 1e9
    assert np.allclose(found.frames.time_s - start_s, TIMES_S, rtol=0, atol=1e-6)
    assert [path.name for path in found.frames.paths] == ["0.png", "1.png", "2.png"]
    inertial = found.instruments.inertial
    assert np.allclose(inertial.time_s - start_s, ends[1:], rtol=0, atol=1e-6)
    assert np.allclose(inertial.interval_s, 0.05, rtol=0, atol=2e-9)
    means = (values[1:] + values[:-1]) / 2
    assert np.allclose(np.hstack([inertial.angular_rate_radps, inertial.specific_force_mps2]), means)
    assert np.allclose(
        found.truth.position_m, START_M + VELOCITY_MPS * (np.array(TIMES_S)[:, None] - TIMES_S[0]), atol=1e-4
    )
    assert np.allclose(found.truth.rotation_camera_from_site, matrix_from_quaternion(DOWN_WXYZ))
    assert np.allclose(found.camera.rotation_camera_from_body, ROTATION_CAMERA_FROM_BODY)
    assert (found.camera.cx_px, found.camera.cy_px) == (32.0, 32.0)


def test_a_gap_of_samples_is_no_interval(folder):
    write_euroc(folder)
    lines = (folder / "imu.txt").read_text().splitlines()
    (folder / "imu.txt").write_text("\n".join(lines[:100] + lines[110:]))
    found = read(folder, "mav0/cam0", "imu.txt", None, None, "sensor.yaml").instruments.inertial
    assert len(found) == len(lines) - 1 - 10 - 2
    assert found.interval_s.max() < 0.051


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (
            "imu.txt",
            str(UNIX_NS + 5_050_000_000),
            str(UNIX_NS),
            ["imu.txt:3: timestamp", f"above {UNIX_NS + 5 * 10**9}"],
        ),
        ("imu.txt", str(UNIX_NS + 5_050_000_000), "soon", ["imu.txt:3: timestamp", "got soon, expected an integer"]),
        ("imu.txt", "a_RS_S_y", "a_RS_S_u", ["imu.txt: columns: got no a_RS_S_y"]),
        ("mav0/cam0/data.csv", "filename", "picture", ["data.csv: columns: got no filename"]),
        ("mav0/cam0/data.csv", ",1.png", ",../1.png", ["data.csv:3: filename", "a file of this folder"]),
        ("mav0/truth.csv", str(UNIX_NS + 9 * 10**9), str(UNIX_NS + 9 * 10**9 + 10**8), []),
        ("mav0/truth.csv", "1.0,0.0,0.0,0.0", "1.0,1.0,0.0,0.0", ["truth.csv:2: q_RS_w", "a unit quaternion"]),
        ("sensor.yaml", "[1.0, 0.0, 0.0, 0.0", "[1.0, 0.0, 0.0, 0.5", ["camera.position_in_body_m", "[0, 0, 0]"]),
    ],
)
def test_faults_in_euroc_files_are_named(folder, file, old, new, words):
    write_euroc(folder)
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    arguments = folder, "mav0/cam0", "imu.txt", None, "mav0/truth.csv", "sensor.yaml"
    if not words:
        assert read(*arguments).truth is not None
        return
    with pytest.raises(UserError) as raised:
        read(*arguments)
    for word in words:
        assert word in str(raised.value)


def test_truth_that_ends_before_the_last_frame_is_refused(folder):
    write_euroc(folder)
    lines = (folder / "mav0/truth.csv").read_text().splitlines()
    (folder / "mav0/truth.csv").write_text("\n".join(lines[:8]))
    with pytest.raises(UserError, match=r"timestamp: got 1403715533.*, expected the time of the frames"):
        read(folder, "mav0/cam0", "imu.txt", None, "mav0/truth.csv", "sensor.yaml")
