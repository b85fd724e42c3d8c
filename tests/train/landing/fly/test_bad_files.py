"""Files of a descent that are wrong: one line that names file, field, value and what would be right."""

import json

import pytest
from tests.helpers import in_process
from tests.train.landing.fly.descent_files import options, write_descent, write_yaml

from perilune_train.cli.main import main


def setting(file, key, value):
    """A change of one value of a YAML file; None removes it."""

    def change(folder):
        content = json.loads((folder / file).read_text(encoding="utf-8"))
        content[key] = value
        if value is None:
            del content[key]
        write_yaml(folder / file, content)

    return change


def text(file, before, after):
    """A change of the text of a file."""

    def change(folder):
        path = folder / file
        content = path.read_text(encoding="utf-8")
        assert before in content
        path.write_text(content.replace(before, after, 1), encoding="utf-8")

    return change


def repeated(file, column):
    """A change that writes a column twice."""

    def change(folder):
        lines = (folder / file).read_text(encoding="utf-8").splitlines()
        place = lines[0].split(",").index(column)
        lines = [",".join([line, line.split(",")[place]]) for line in lines]
        (folder / file).write_text("\n".join(lines), encoding="utf-8")

    return change


def missing(file):
    return lambda folder: (folder / file).unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (missing("camera.yaml"), ["camera.yaml", "no such file"]),
        (missing("frames/frames.csv"), ["frames.csv", "no such file", "CSV"]),
        (missing("frames/1.png"), ["1.png", "no such file"]),
        (missing("imu.csv"), ["imu.csv", "no such file"]),
        (missing("catalogue.csv"), ["catalogue.csv", "no such file"]),
        (setting("camera.yaml", "fx_px", -3), ["camera.yaml", "camera.fx_px", "-3", "above 0"]),
        (setting("camera.yaml", "fx_pix", 3), ["camera.yaml", "camera.fx_pix", "unknown key", "fx_px (nearest known)"]),
        (setting("camera.yaml", "width_px", 128), ["0.png", "size", "64 x 64", "128 x 64"]),
        (setting("camera.yaml", "position_in_body_m", [0, 0, 1]), ["position_in_body_m", "[0, 0, 0]"]),
        (setting("camera.yaml", "distortion", [-3.0, 0, 0, 0, 0]), ["camera.distortion", "fold"]),
        (setting("camera.yaml", "model", "equidistant"), ["camera.model", "equidistant", "expected pinhole"]),
        (setting("camera.yaml", "model", "fish"), ["camera", "model pinhole, equidistant"]),
        (setting("prior.yaml", "position_m", None), ["prior.yaml", "prior.position_m", "nothing", "a value"]),
        (setting("prior.yaml", "positon_m", [1, 2, 3]), ["prior.positon_m", "unknown key", "position_m (nearest"]),
        (setting("prior.yaml", "rotation_wxyz", [1, 1, 0, 0]), ["prior", "a unit quaternion"]),
        (setting("prior.yaml", "inertial", "cheap"), ["prior.inertial", "'cheap'"]),
        (setting("prior.yaml", "position_sigma_m", 0), ["prior.position_sigma_m", "0", "above 0"]),
        (text("prior.yaml", "{", "!!python/object/apply:os.system {"), ["prior.yaml", "syntax", "tag"]),
        (text("imu.csv", "interval_s", "interval"), ["imu.csv", "columns", "no interval_s"]),
        (text("imu.csv", "interval_s", "time_s"), ["imu.csv", "columns", "no interval_s"]),
        (text("imu.csv", "angular_rate_y_radps", "time_s"), ["imu.csv", "columns", "no angular_rate_y_radps"]),
        (repeated("ranges.csv", "range_m"), ["ranges.csv", "columns", "2 times range_m", "once"]),
        (repeated("frames/frames.csv", "file"), ["frames.csv", "columns", "2 times file", "once"]),
        (text("catalogue.csv", "z_m", "x_m"), ["catalogue.csv", "columns", "no z_m"]),
        (text("imu.csv", "5.05,", "4.05,"), ["imu.csv:3: time_s", "4.05", "above 5.0"]),
        (text("imu.csv", "5.05,", "soon,"), ["imu.csv:3: time_s", "soon", "a number"]),
        (text("imu.csv", "5.05,0.05,", "5.05,-1,"), ["imu.csv:3: interval_s", "-1"]),
        (text("ranges.csv", "5.5,", "4.5,"), ["ranges.csv:3: time_s", "above 5.0"]),
        (text("frames/frames.csv", "11.0", "9.0"), ["frames.csv:3: time_s", "9.0", "above 10.0"]),
        (text("frames/frames.csv", "1.png", "../camera.yaml"), ["frames.csv:3: file", "a file of this folder"]),
        (text("catalogue.csv", ",30.0", ",-30.0"), ["catalogue.csv:2", "diameter_m", "-30.0", "above 0"]),
        (text("catalogue.csv", ",30.0", ","), ["catalogue.csv:2", "diameter_m", "nothing", "a finite number"]),
        (text("truth.csv", "11.0", "11.5"), ["truth.csv", "time_s", "the times of the 3 frames"]),
    ],
)
def test_one_line_exit_code_2_and_nothing_written(tmp_path, change, words, monkeypatch):
    folder = write_descent(tmp_path / "descent")
    change(folder)
    monkeypatch.chdir(tmp_path)
    done = in_process.call(main, "navigate", "fly", *options(folder), "--out", "flight")
    assert done.returncode == 2, done.stdout + done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    for word in words:
        assert word in lines[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["descent"]


STARS = "time_s,rotation_w,rotation_x,rotation_y,rotation_z\n10.5,1,0,0,0\n11.5,,,,\n"
LIDAR = "time_s,beam_x_body,beam_y_body,beam_z_body,speed_mps,range_m\n10.5,0.6,0,-0.8,24,1100\n10.5,0,0,-1,30,\n"


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("star_tracker", STARS.replace("1,0,0,0", "1,1,0,0"), ["csv:2: rotation_w", "a unit quaternion, or nothing"]),
        ("star_tracker", STARS.replace("11.5", "10.5"), ["csv:3: time_s", "above 10.5"]),
        ("star_tracker", STARS.replace("rotation_y", "rotation_k"), ["columns", "no rotation_y"]),
        ("star_tracker", STARS.replace("10.5", "1.05e19").replace("11.5", "1.15e19"), ["time_s", "divide by 1e9"]),
        ("doppler_lidar", LIDAR.replace("0.6", "0.7"), ["csv:2: beam_z_body", "a unit vector"]),
        ("doppler_lidar", LIDAR.replace("0,0,-1", "0,0,1"), ["csv:3: beam_z_body", "1.0", "points down"]),
        ("doppler_lidar", LIDAR.replace("10.5,0,", "10.4,0,"), ["csv:3: time_s", "at least 10.5"]),
        ("doppler_lidar", LIDAR.replace("24", "fast"), ["csv:2: speed_mps", "fast", "a number"]),
        ("doppler_lidar", LIDAR.replace("10.5", "510.5"), ["time_s", "the clock of"]),
    ],
)
def test_wrong_measurements_of_other_sensors(tmp_path, file, content, words, monkeypatch):
    folder = write_descent(tmp_path / "descent")
    (folder / f"{file}.csv").write_text(content, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    option = "--" + file.replace("_", "-"), folder / f"{file}.csv"
    done = in_process.call(main, "navigate", "fly", *options(folder), *option, "--out", "flight")
    assert done.returncode == 2, done.stdout + done.stderr
    (line,) = done.stderr.strip().splitlines()
    for word in words:
        assert word in line
    assert not (tmp_path / "flight").exists()


@pytest.mark.parametrize("change", [["--no-imu"], []], ids=["both", "neither"])
def test_an_inertial_unit_is_given_or_refused(tmp_path, change):
    folder = write_descent(tmp_path / "descent")
    words = options(folder)
    if not change:
        del words[words.index("--imu") : words.index("--imu") + 2]
    done = in_process.call(main, "navigate", "fly", *words, *change, "--out", tmp_path / "flight")
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert "--imu" in line and "--no-imu" in line
    assert not (tmp_path / "flight").exists()


@pytest.mark.parametrize("live", ["live.txt", "live"])
def test_a_live_picture_that_is_no_png(tmp_path, live):
    folder = write_descent(tmp_path / "descent")
    words = [*options(folder), "--out", tmp_path / "flight", "--live", tmp_path / live]
    done = in_process.call(main, "navigate", "fly", *words)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "--live" in done.stderr
    assert ".png" in done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["descent"]


def test_a_parquet_file_that_is_truncated(tmp_path):
    folder = write_descent(tmp_path / "descent")
    (folder / "craters.parquet").write_bytes(b"PAR1 and no more")
    done = in_process.call(main, "navigate", "fly", *options(folder, "craters.parquet"), "--out", tmp_path / "flight")
    assert done.returncode == 2
    assert "craters.parquet" in done.stderr
    assert not (tmp_path / "flight").exists()
