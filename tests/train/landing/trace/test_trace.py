"""Traces of the landing filter: recorded, reproduced, compared and replayed."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scripts.reference_traces import RECIPES, TRACES
from scripts.trace_page import PAGE, page
from tests.helpers import in_process
from tests.train.landing.fly.descent_files import write_descent

from perilune_train.cli.main import main
from perilune_train.landing.craters.sightings import PREDICTED_STATIC
from perilune_train.landing.filter.flight import fly
from perilune_train.landing.fly.run import lander_of, sightings
from perilune_train.landing.trace.columns import TABLES
from perilune_train.landing.trace.compare import compare_traces
from perilune_train.landing.trace.write import INPUTS, flown, read_inputs, trace_of, write_table

ROOT = TRACES.parent.parent
REGENERATE = "the filter has changed: type  make traces  and state the change in docs/reference/landing-filter.md"


@pytest.fixture(scope="module")
def again(tmp_path_factory):
    """The reference traces, made again from their inputs."""
    made = tmp_path_factory.mktemp("again")
    for name in RECIPES:
        (made / name).mkdir()
        for table, rows in trace_of(TRACES / name / INPUTS).items():
            write_table(rows, made / name / f"{table}.parquet")
    return made


@pytest.mark.parametrize("name", RECIPES)
def test_the_filter_reproduces_the_reference_traces(name, again):
    compared = compare_traces(TRACES / name, again / name, 1e-9)
    assert not compared[-1].difference, f"{compared[-1].difference}; {REGENERATE}"
    assert [each.table for each in compared] == [table.name for table in TABLES]
    assert all(each.n_columns == each.of_columns > 0 for each in compared)
    assert all(each.n_rows for each in compared)


def test_the_page_has_the_constants_and_columns_of_the_code():
    text = PAGE.read_text(encoding="utf-8")
    assert page(text) == text, REGENERATE
    for table in TABLES:
        assert f"### `{table.name}`" in text


def test_the_page_shows_code_of_the_example():
    (shown,) = re.findall(r"```py\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert shown in (ROOT / "examples/replay_trace.py").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["nominal", "restart"])
def test_the_example_replays_steps(name):
    command = [sys.executable, "examples/replay_trace.py", str(TRACES / name)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 1e-9


def test_the_reference_traces_have_every_kind_of_step_and_are_small():
    steps, frames = (
        pd.concat(pd.read_parquet(TRACES / n / f"{t}.parquet") for n in RECIPES) for t in ("steps", "frames")
    )
    kinds = {"propagate", "coast", "attitude", "beam_range", "beam_speed", "range", "frame"}
    assert set(steps["kind"]) == kinds
    refused = steps[(steps["accepted"] == 0) & (steps["kind"] != "frame")]
    assert {"range", "beam_speed", "attitude"} <= set(refused["kind"])
    assert set(frames["outcome"]) == {"no_fix", "update", "restart", "contradiction"}
    assert set(frames["status"]) == {"tracking", "coasting", "lost"}
    assert set(frames["searched"]) == {-1, 0, 1}
    assert sum(path.stat().st_size for path in TRACES.rglob("*")) < 2_100_000


@pytest.mark.parametrize(("change", "tolerance"), [(1e-15, 1e-10), (1e-9, 1e-5)])
@pytest.mark.parametrize("name", RECIPES)
def test_small_changes_of_the_inputs_have_small_effects(name, change, tolerance, tmp_path):
    """No decision changes, so other implementations can agree to 1e-9 although they round differently."""
    rng = np.random.default_rng(1)

    def changed(values):
        return values * (1 + change * rng.uniform(-1, 1, np.shape(values)))

    descent, detect = read_inputs(TRACES / name / INPUTS)
    instruments, catalogue = descent.instruments, descent.catalogue
    rate, force = (
        changed(getattr(instruments.inertial, part)) for part in ("angular_rate_radps", "specific_force_mps2")
    )
    inertial = replace(instruments.inertial, angular_rate_radps=rate, specific_force_mps2=force)
    instruments = replace(instruments, inertial=inertial, range_m=changed(instruments.range_m))
    catalogue = replace(catalogue, centre_m=changed(catalogue.centre_m), radius_m=changed(catalogue.radius_m))
    for table, rows in flown(replace(descent, instruments=instruments, catalogue=catalogue), detect).items():
        write_table(rows, tmp_path / f"{table}.parquet")
    compared = compare_traces(TRACES / name, tmp_path, tolerance)
    assert not compared[-1].difference
    assert max(each.largest for each in compared) > 0


def test_a_recorder_changes_nothing(again):
    descent, detect = read_inputs(TRACES / "restart" / INPUTS)
    lander = lander_of(descent)
    estimates = list(fly(lander, descent.instruments, descent.frames.time_s, sightings(descent, detect, {})))
    frames = pd.read_parquet(again / "restart/frames.parquet")
    assert [estimate.status for estimate in estimates] == frames["status"].to_list()
    assert np.array_equal([estimate.state.position_m for estimate in estimates], frames[["x_m", "y_m", "z_m"]])
    assert [estimate.n_refused for estimate in estimates] == frames["n_refused"].to_list()


@pytest.fixture
def copied(tmp_path):
    """The tables of a reference trace in another folder, without inputs."""
    folder = tmp_path / "mine"
    shutil.copytree(TRACES / "restart", folder, ignore=shutil.ignore_patterns(INPUTS))
    return folder


def checked(folder, *more):
    return in_process.call(main, "navigate", "check-trace", TRACES / "restart", folder, *more)


def change(path, name, row, value):
    table = pd.read_parquet(path)
    table.loc[row, name] = value(table.loc[row, name])
    table.to_parquet(path, index=False)


def test_an_equal_trace_has_code_0(copied):
    done = checked(copied)
    assert done.returncode == 0, done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [table.name for table in TABLES]


@pytest.mark.parametrize(
    ("table", "name", "value", "expected"),
    [
        ("steps", "covariance_3_4", lambda old: old + 1e-3, r"steps: step 4: covariance_3_4: got .*, a difference of"),
        ("steps", "kind", lambda old: "coast", "steps: step 4: kind: got coast, expected "),
        ("steps", "ground_m", lambda old: np.nan, "steps: step 4: ground_m: got nan, expected "),
        ("frames", "n_matched", lambda old: old + 1, "frames: frame 4: n_matched: got "),
        ("matches", "crater", lambda old: old + 1, r"matches: frame \d+, sighting \d+: crater: got "),
    ],
)
def test_a_difference_has_code_1_and_names_row_and_column(copied, table, name, value, expected):
    change(copied / f"{table}.parquet", name, 4, value)
    done = checked(copied)
    assert done.returncode == 1
    assert re.search(expected, done.stdout.splitlines()[-1]), done.stdout
    assert len(done.stdout.splitlines()) == [each.name for each in TABLES].index(table) + 1


def test_differences_are_divided_by_the_scale_of_their_column(copied):
    steps = copied / "steps.parquet"
    table = pd.read_parquet(steps)
    row = int(table.index[table["kind"] == "range"][3])
    sigma = table["innovation_covariance_0_0"][row] ** 0.5
    change(steps, "innovation_0", row, lambda old: old + 0.5e-9 * sigma)
    change(
        steps,
        "covariance_2_5",
        7,
        lambda old: old + 0.5e-9 * (table["covariance_2_2"] * table["covariance_5_5"])[7] ** 0.5,
    )
    change(steps, "z_m", 7, lambda old: old + 0.5e-9 * old)
    assert checked(copied).returncode == 0
    assert checked(copied, "--tolerance", "0.4e-9").returncode == 1
    change(steps, "innovation_0", row, lambda old: old + 1e-9 * sigma)
    done = checked(copied)
    assert done.returncode == 1
    assert f"steps: step {row}: innovation_0: " in done.stdout


def test_some_tables_and_columns_as_csv_suffice(copied, tmp_path):
    folder = tmp_path / "csv"
    folder.mkdir()
    steps = pd.read_parquet(copied / "steps.parquet")[["step", "kind", "z_m", "innovation_0"]].iloc[::-1]
    steps.assign(own=1.0).to_csv(folder / "steps.csv", index=False, float_format="%.17g")
    done = checked(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.fullmatch(r"steps: \d+ rows, 3 of \d+ columns, largest difference 0.0e\+00\n", done.stdout)


@pytest.mark.parametrize("table", ["steps", "matches"])
def test_missing_and_further_rows_are_differences(copied, table):
    path = copied / f"{table}.parquet"
    rows = pd.read_parquet(path)
    rows.drop(index=5).to_parquet(path, index=False)
    done = checked(copied)
    assert done.returncode == 1
    assert done.stdout.endswith(": no such row\n")
    pd.concat([rows, rows.tail(1).assign(**{rows.columns[0]: 10_000})]).to_parquet(path, index=False)
    done = checked(copied)
    assert done.returncode == 1
    assert done.stdout.endswith(": a row that the reference lacks\n")


def _text(path):
    pd.read_parquet(path).assign(z_m="high").to_parquet(path, index=False)


def _twice(path):
    rows = pd.read_parquet(path)
    pd.concat([rows, rows.head(1)]).to_parquet(path, index=False)


def _no_key(path):
    pd.read_parquet(path).drop(columns="step").to_parquet(path, index=False)


def _only_keys(path):
    pd.read_parquet(path)[["step"]].to_parquet(path, index=False)


def _noise(path):
    path.write_bytes(b"PAR1" + bytes(range(256)))


@pytest.mark.parametrize("damage", [_text, _twice, _no_key, _only_keys, _noise])
def test_a_table_that_cannot_be_read_has_code_2_and_one_line(copied, damage):
    damage(copied / "steps.parquet")
    done = checked(copied)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "steps.parquet" in done.stderr


@pytest.mark.parametrize("name", ["empty", "missing"])
def test_a_folder_without_tables_has_code_2(tmp_path, name):
    (tmp_path / "empty").mkdir()
    done = checked(tmp_path / name)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """A trace of a short descent with a table of detections, and the folder of the descent."""
    folder = write_descent(tmp_path_factory.mktemp("trace") / "descent")
    catalogue = pd.read_csv(folder / "catalogue.csv").assign(diameter_m=lambda rows: rows["diameter_m"] + rows.index)
    catalogue.to_parquet(folder / "catalogue.parquet", index=False)
    boxes = {
        "image": ["0.png", "0.png"],
        "x0_px": [3.0, 20],
        "y0_px": [4.0, 9],
        "x1_px": [9.0, 30],
        "y1_px": [11.0, 20],
    }
    pd.DataFrame(boxes | {"score": [0.9, 0.6]}).to_parquet(folder / "detections.parquet", index=False)
    done = in_process.call(main, "navigate", "trace", "--descent", folder, "--out", folder.parent / "out")
    assert done.returncode == 0, done.stderr
    return folder, folder.parent / "out"


def test_a_trace_of_files_is_reproduced_from_its_inputs(traced, tmp_path):
    out = traced[1]
    done = in_process.call(main, "navigate", "trace", "--descent", out / INPUTS, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    done = in_process.call(main, "navigate", "check-trace", out, tmp_path / "again")
    assert done.returncode == 0, done.stdout + done.stderr
    names = {path.name for path in (out / INPUTS).iterdir()}
    assert names == {
        *("camera.yaml", "prior.yaml", "catalogue.parquet", "frames.parquet", "detections.parquet"),
        *("imu.parquet", "ranges.parquet"),
    }
    sighted = pd.read_parquet(out / "sightings.parquet")
    assert sighted["radius_px"].to_list() == [110**0.5 / 2, 42**0.5 / 2]
    assert len(pd.read_parquet(out / "frames.parquet")) == 3


def test_a_trace_keeps_predicted_deviations(traced, tmp_path):
    folder = tmp_path / "descent"
    shutil.copytree(traced[0], folder)
    found = pd.read_parquet(folder / "detections.parquet").assign(sigma_x_px=[0.5, 0.2], sigma_y_px=[0.7, 0.2])
    found.to_parquet(folder / "detections.parquet", index=False)
    done = in_process.call(main, "navigate", "trace", "--descent", folder, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    kept = pd.read_parquet(tmp_path / "out" / INPUTS / "detections.parquet")
    pd.testing.assert_frame_equal(kept[found.columns], found, check_dtype=False)
    before, after = (pd.read_parquet(out / "sightings.parquet") for out in (traced[1], tmp_path / "out"))
    assert after["score"].to_list() == before["score"].to_list() == [0.6, 0.9]
    np.testing.assert_allclose(after["static_px"], PREDICTED_STATIC * np.array([0.2, 0.37**0.5]))
    assert (after["noise_px"] != before["noise_px"]).all()
    again = in_process.call(main, "navigate", "trace", "--descent", tmp_path / "out" / INPUTS, "--out", tmp_path / "b")
    assert again.returncode == 0, again.stderr
    assert in_process.call(main, "navigate", "check-trace", tmp_path / "out", tmp_path / "b").returncode == 0


@pytest.mark.parametrize("name", ["camera.yaml", "detections.parquet", "catalogue.parquet"])
def test_missing_inputs_have_code_2_and_leave_nothing(traced, tmp_path, name):
    inputs = tmp_path / "inputs"
    shutil.copytree(traced[1] / INPUTS, inputs)
    (inputs / name).unlink()
    done = in_process.call(main, "navigate", "trace", "--descent", inputs, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and name in done.stderr
    assert not (tmp_path / "out").exists()


def test_no_folder_has_code_2(tmp_path):
    done = in_process.call(main, "navigate", "trace", "--descent", tmp_path / "no", "--out", tmp_path / "out")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert Path(tmp_path / "out").exists() is False
