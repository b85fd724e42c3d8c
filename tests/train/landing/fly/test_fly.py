"""A descent from files, from the command to its results."""

import dataclasses

import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process
from tests.train.landing.fly.descent_files import START_M, TIMES_S, VELOCITY_MPS, options, write_descent

import perilune
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import Camera
from perilune_train.cli.main import main
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.landing.fly.run import sightings_of


def flown(folder, out, *more, catalogue="catalogue.csv"):
    done = in_process.call(main, "navigate", "fly", *options(folder, catalogue), "--out", out, *more)
    assert done.returncode == 0, done.stderr
    return pd.read_parquet(out / "estimates.parquet"), done.stdout


def position(table):
    return table[["x_m", "y_m", "z_m"]].to_numpy()


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A flight over noise, without a crater in view."""
    folder = write_descent(tmp_path_factory.mktemp("plain") / "descent")
    table, shown = flown(folder, folder.parent / "flight", "--live", folder.parent / "live.png")
    return folder, table, shown


def test_a_line_for_each_frame_and_a_table(plain):
    folder, table, shown = plain
    assert table["time_s"].tolist() == list(TIMES_S)
    assert table["file"].tolist() == ["0.png", "1.png", "2.png"]
    lines = [line for line in shown.splitlines() if " deg " in line]
    assert [line.split()[0] for line in lines] == ["10.00", "11.00", "12.00"]
    assert "position error" in shown
    text = pd.read_csv(folder.parent / "flight" / "estimates.csv").fillna(
        {"fault": "", "disagreeing": "", "suspect": ""}
    )
    pd.testing.assert_frame_equal(text, table, check_dtype=False)
    assert (folder.parent / "flight" / "flight.png").stat().st_size > 10_000
    assert (folder.parent / "live.png").is_file()


def test_without_craters_it_follows_the_inertial_unit_and_says_so(plain):
    _, table, _ = plain
    assert set(table["status"]) == {"coasting"}
    true = START_M + VELOCITY_MPS * (np.array(TIMES_S)[:, None] - TIMES_S[0])
    error = position(table) - true
    # The prior is off by 1 m on each axis; the height of the ground is not known well enough for ranges to change it.
    assert np.abs(error[:, :2] - 1).max() < 0.5
    assert np.abs(error[:, 2]).max() < 1.5
    assert np.allclose(table[["error_x_m", "error_y_m", "error_z_m"]], error, atol=1e-9)
    sigma = table[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()
    assert (np.abs(error) < 3 * sigma).all()
    assert sigma[-1, 0] > sigma[0, 0]


def test_a_star_tracker_and_a_doppler_lidar_make_it_more_certain(tmp_path, plain):
    folder = write_descent(tmp_path / "descent")
    time_s = np.arange(9.0, 12.5, 0.5)
    level = {f"rotation_{axis}": float(axis == "w") for axis in "wxyz"}
    pd.DataFrame({"time_s": time_s, **level}).to_csv(folder / "star_tracker.csv", index=False)
    beams = {"beam_x_body": 0.6, "beam_y_body": 0.0, "beam_z_body": -0.8}
    along = VELOCITY_MPS @ list(beams.values())
    rows = {"time_s": time_s, **beams, "speed_mps": along, "range_m": [None] * len(time_s)}
    pd.DataFrame(rows).to_csv(folder / "doppler_lidar.csv", index=False)
    more = "--star-tracker", folder / "star_tracker.csv", "--doppler-lidar", folder / "doppler_lidar.csv"
    table, shown = flown(folder, tmp_path / "flight", *more)
    assert table["n_refused"].tolist() == [0, 0, 0] and "refused" not in shown
    for name in ("sigma_attitude_x_deg", "sigma_x_m"):
        assert table[name].iloc[-1] < plain[1][name].iloc[-1]
    # An attitude that contradicts the state is refused, and counted.
    level |= {"rotation_w": 0.0, "rotation_x": 1.0}
    pd.DataFrame({"time_s": time_s, **level}).to_csv(folder / "star_tracker.csv", index=False)
    done = in_process.call(main, "navigate", "fly", *options(folder), "--out", tmp_path / "other", *more)
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(tmp_path / "other" / "estimates.parquet")
    assert table["n_refused"].tolist() == [1, 2, 2]
    assert table["disagreeing"].tolist() == ["", "star tracker", "star tracker"]
    assert table["status"].tolist() == ["coasting", "lost", "lost"]
    assert "warning: sensors that disagree with the state" in done.stdout + done.stderr
    assert "star tracker (2 of 3 frames, from 11.00 s)" in done.stdout + done.stderr


def test_without_an_inertial_unit_it_keeps_its_velocity(tmp_path, plain):
    folder = write_descent(tmp_path / "descent")
    (folder / "imu.csv").unlink()
    words = options(folder)
    del words[words.index("--imu") : words.index("--imu") + 2]
    done = in_process.call(main, "navigate", "fly", *words, "--no-imu", "--out", tmp_path / "flight")
    assert done.returncode == 0, done.stderr
    table = pd.read_parquet(tmp_path / "flight" / "estimates.parquet")
    assert np.allclose(position(table), position(plain[1]), atol=1.5)
    assert table["sigma_x_m"].iloc[-1] > 1.3 * plain[1]["sigma_x_m"].iloc[-1]


def test_frames_that_are_not_regolith_are_named_once_a_flight(tmp_path):
    folder = write_descent(tmp_path / "descent", size_px=160)
    done = in_process.call(main, "navigate", "fly", *options(folder), "--out", tmp_path / "flight")
    assert done.returncode == 0, done.stderr
    assert pd.read_parquet(tmp_path / "flight" / "estimates.parquet")["suspect"].tolist() == ["noise"] * 3
    warnings = [line for line in done.stderr.splitlines() if "regolith" in line]
    assert warnings == ["warning: 3 of 3 frames may not show regolith (3 noise; first 0.png): column suspect"]
    (folder / "catalogue.csv").rename(folder / "catalogue.parquet")
    by_call = perilune.fly(folder, detector=lambda image: [])
    assert by_call["suspect"].tolist() == ["noise"] * 3


def test_a_damaged_frame_is_flown_over_and_named(tmp_path, plain):
    folder = write_descent(tmp_path / "descent")
    image = folder / "frames" / "1.png"
    image.write_bytes(image.read_bytes()[:2000])
    table, shown = flown(folder, tmp_path / "flight")
    assert "1.png" in table["fault"][1] and "1.png" in shown
    assert table["fault"][[0, 2]].tolist() == ["", ""]
    assert np.allclose(position(table), position(plain[1]), atol=1e-6)


@pytest.mark.parametrize("gone", ["rows", pytest.param("nan", marks=pytest.mark.slow)])
def test_a_gap_of_the_inertial_unit_is_bridged(tmp_path, plain, gone):
    folder = write_descent(tmp_path / "descent")
    imu = pd.read_csv(folder / "imu.csv")
    gap = imu["time_s"] > 10.6
    if gone == "rows":
        imu = imu[~gap]
    else:
        imu.loc[gap, [name for name in imu if name.startswith(("angular", "specific"))]] = np.nan
    imu.to_csv(folder / "imu.csv", index=False)
    table, _ = flown(folder, tmp_path / "flight")
    # Constant velocity is the truth here: the position goes on, and is less certain.
    assert np.abs(position(table) - position(plain[1])).max() < 0.5
    assert table["sigma_x_m"].iloc[-1] > 1.1 * plain[1]["sigma_x_m"].iloc[-1]


def test_boxes_of_a_distorting_lens_become_those_of_a_pinhole():
    camera = dataclasses.replace(Camera.from_field_of_view(256, 256, 60.0), distortion=(-0.15, 0.02, 1e-3, -5e-4, 0.0))
    pinhole = camera.covering_pinhole()
    rng = np.random.default_rng(0)
    middle, half = rng.uniform(30, pinhole.width_px - 30, (40, 2)), rng.uniform(2, 6, 40)
    angle = np.linspace(0, 2 * np.pi, 200)
    circles = middle[:, None] + half[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    seen = camera.project(pinhole.rays(circles))
    inside = camera.inside(seen).all(axis=1)
    assert inside.sum() > 20
    boxes = np.concatenate([seen.min(axis=1), seen.max(axis=1)], axis=1)[inside]
    moved = np.linalg.norm((boxes[:, :2] + boxes[:, 2:]) / 2 - middle[inside], axis=1)
    assert moved.max() > 3
    found = sightings_of(Detections(boxes, np.ones(len(boxes))), camera)
    near = np.linalg.norm(found.centre_px[:, None] - middle[inside][None], axis=2)
    match = near.argmin(axis=1)
    assert near.min(axis=1).max() < 0.05
    assert np.abs(found.radius_px / half[inside][match] - 1).max() < 0.03
    # A predicted deviation is stretched as its box: a tenth of the side remains a tenth of the side.
    tenth = (boxes[:, 2:] - boxes[:, :2]) / 10
    shapes = np.column_stack([np.zeros(len(boxes)), tenth, tenth])
    stretched = sightings_of(Detections(boxes, np.ones(len(boxes)), shapes), camera)
    np.testing.assert_allclose(stretched.sigma_px, found.radius_px / 5, rtol=0.03)


def unpack(dataset, trajectory, out):
    return in_process.call(main, "navigate", "descent", "--dataset", dataset, "--trajectory", trajectory, "--out", out)


def test_a_dataset_unpacked_and_flown(quick, tmp_path):
    row = open_dataset(quick / "nav").trajectories.iloc[-1]
    unpacked = unpack(quick / "nav", f"{row['scene_id']}/{row['trajectory_id']}", tmp_path / "descent")
    assert unpacked.returncode == 0, unpacked.stderr
    table, _ = flown(tmp_path / "descent", tmp_path / "flight", catalogue="catalogue.parquet")
    assert len(table) == row["n_frames"]
    error = np.linalg.norm(table[["error_x_m", "error_y_m", "error_z_m"]], axis=1)
    sigma = np.linalg.norm(table[["sigma_x_m", "sigma_y_m", "sigma_z_m"]], axis=1)
    # Small frames show few craters: what counts is that nothing is wrong and claims to be right.
    assert (error < 5 * sigma).all()
    assert np.isfinite(table["error_attitude_deg"]).all()


def test_a_trajectory_that_does_not_exist(quick, tmp_path):
    unpacked = unpack(quick / "nav", "nowhere/none", tmp_path / "descent")
    assert unpacked.returncode == 2
    assert "nowhere/none" in unpacked.stderr
    assert "one of its" in unpacked.stderr
    assert not (tmp_path / "descent").exists()
