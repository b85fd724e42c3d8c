"""Monte Carlo over a rendered dataset, from the command to its page."""

import json
import shutil

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from tests.helpers import in_process

from perilune_train.cli.main import main


def monte_carlo(*arguments):
    return in_process.call(main, "navigate", "monte-carlo", *arguments)


@pytest.fixture(scope="module")
def drawn(quick, tmp_path_factory):
    """Folder of three draws of each descent, in this process."""
    out = tmp_path_factory.mktemp("draws") / "draws"
    done = monte_carlo("--dataset", quick / "nav", "--out", out, "--draws", 3, "--workers", 1)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_two_workers_give_the_same_draws(drawn, quick, tmp_path):
    done = monte_carlo("--dataset", quick / "nav", "--out", tmp_path / "two", "--draws", 3, "--workers", 2)
    assert done.returncode == 0, done.stderr
    tables = [pd.read_parquet(out / "draws.parquet") for out in (drawn, tmp_path / "two")]
    pd.testing.assert_frame_equal(*tables)


def test_a_page_of_all_flights(drawn, quick):
    out = drawn
    rows = pd.read_parquet(out / "draws.parquet")
    assert sorted(rows["draw"].unique()) == [0, 1, 2]
    starts = rows.groupby(["trajectory_id", "draw"])["error_m"].first()
    assert starts.is_unique
    page = (out / "monte_carlo.md").read_text(encoding="utf-8")
    assert f"{len(starts)} flights, {len(rows)} frames" in page
    for name in ("errors.png", "consistency.png", "ellipses.png", "miss.png"):
        assert (out / name).stat().st_size > 10_000
        assert f"]({name})" in page
    frames = pd.read_parquet(out / "consistency.parquet")
    assert len(frames) == len(rows) / 3
    assert (frames["n_draws"] == 3).all()
    descents = json.loads((out / "consistency.json").read_text(encoding="utf-8"))
    assert {one["trajectory_id"] for one in descents} == set(rows["trajectory_id"])
    assert all(one["miss_99_bound_m"] is None for one in descents)
    assert "3 draws do not support it" in page
    assert not (out / "detector_errors.json").exists()
    again = monte_carlo("--dataset", quick / "nav", "--out", out)
    assert again.returncode == 2
    assert len(again.stderr.strip().splitlines()) == 1


def test_a_draw_can_be_repeated_alone(drawn, quick, tmp_path):
    out = tmp_path / "alone"
    done = monte_carlo(
        "--dataset", quick / "nav", "--out", out, "--draws", 1, "--first-draw", 2, "--workers", 1, "--imu", "tactical"
    )
    assert done.returncode == 0, done.stderr
    rows = pd.read_parquet(drawn / "draws.parquet")
    expected = rows[rows["draw"] == 2].reset_index(drop=True)
    pd.testing.assert_frame_equal(pd.read_parquet(out / "draws.parquet"), expected, rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module")
def equipped(quick, tmp_path_factory):
    """Folder of two draws of each descent with all sensors, outages, and drawn detections."""
    out = tmp_path_factory.mktemp("equipped") / "draws"
    options = {
        "--imu": "cubesat", "--scale-ppm": 2000, "--misalignment-arcsec": 300, "--altimeter": "recorded",
        "--star-tracker-hz": 2, "--doppler-hz": 5, "--star-tracker-outage-s": 3, "--altimeter-outage-s": 4,
        "--detections-outage-s": 5, "--detections": "drawn", "--seed": 3,
    }  # fmt: skip
    done = monte_carlo(
        "--dataset",
        quick / "nav",
        "--out",
        out,
        "--draws",
        2,
        "--workers",
        1,
        *(part for pair in options.items() for part in pair),
    )
    assert done.returncode == 0, done.stderr
    return out


def test_all_sensors_fly_and_the_page_says_so(equipped):
    page = (equipped / "monte_carlo.md").read_text(encoding="utf-8")
    assert "`cubesat`" in page
    assert "scale factors of 2000 millionths, misalignments of 300 seconds of arc" in page
    assert "star tracker: 2 Hz" in page and "Doppler lidar: 5 Hz" in page
    assert "star tracker 3 s, altimeter 4 s, detections 5 s" in page
    assert "Altimeter: the recorded ranges in all draws" in page
    errors = json.loads((equipped / "detector_errors.json").read_text(encoding="utf-8"))
    assert len(errors["common_px"]) == 5
    assert 0 < errors["noise_factor"] < 10
    rows = pd.read_parquet(equipped / "draws.parquet")
    assert np.isfinite(rows["squared"]).all()


def test_a_star_tracker_makes_attitudes_more_accurate(drawn, equipped):
    """With a star tracker, the first frames aside, attitudes are correct to about an hundredth of a degree."""
    turns = {}
    for name, out in (("without", drawn), ("with", equipped)):
        rows = pd.read_parquet(out / "draws.parquet")
        turns[name] = rows[rows["time_s"] > rows["time_s"].max() / 2]["turn_deg"].median()
    assert turns["with"] < 0.5 * turns["without"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--dataset", "nowhere"], ["nowhere", "no such file"]),
        (["--dataset", "nowhere", "--split", "tset"], ["--split", "tset", "one of train, val, test"]),
        (["--dataset", "nowhere", "--scenario", "outige"], ["--scenario", "outige", "outage"]),
        (["--dataset", "nowhere", "--imu", "navigation"], ["--imu", "navigation", "cubesat, tactical, calibrated"]),
        (["--dataset", "nowhere", "--altimeter", "radar"], ["--altimeter", "radar", "drawn, recorded, none"]),
        (["--dataset", "nowhere", "--detections", "all"], ["--detections", "all", "recorded, drawn"]),
        (["--dataset", "nowhere", "--star-tracker-outage-s", "5"], ["--star-tracker-outage-s", "--star-tracker-hz"]),
        (
            ["--dataset", "nowhere", "--altimeter", "none", "--altimeter-outage-s", "5"],
            ["--altimeter-outage-s", "an altimeter"],
        ),
    ],
)
def test_mistakes_get_one_line(tmp_path, arguments, words):
    done = monte_carlo(*arguments, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert all(word in done.stderr for word in words)
    assert not (tmp_path / "out").exists()


def test_descents_without_inertial_measurements_are_refused(quick, tmp_path):
    bare = shutil.copytree(quick / "nav", tmp_path / "nav")
    for part in (bare / "manifest" / "inertial").glob("*.parquet"):
        table = pq.read_table(part)
        pq.write_table(table.filter(pc.equal(table["grade"], "tactical")), part)
    done = monte_carlo("--dataset", bare, "--out", tmp_path / "out")
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error")]
    assert "inertial" in line and "grade navigation" in line
    assert not (tmp_path / "out").exists()
