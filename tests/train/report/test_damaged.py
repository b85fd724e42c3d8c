"""Damaged files of runs and datasets: refused in one line that names the file, and nothing is written."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.train.report.conftest import report_command

from perilune_shared.errors import UserError
from perilune_train.report.detection import detection_section
from perilune_train.report.explanation import explanation_section
from perilune_train.report.frames import read_masks
from perilune_train.report.navigation import navigation_section
from perilune_train.report.page import write_report
from perilune_train.report.paper.detections import read_detections
from perilune_train.report.sources import read_run


@pytest.mark.parametrize(
    ("damage", "field"),
    [
        (lambda c: c.pop("low"), "low"),
        (lambda c: c.update(low=np.zeros(5, np.float32)), "low"),
        (lambda c: c.update(low=np.array([0, np.nan], np.float32)), "low"),
        (lambda c: c.update(high=np.array([np.inf, 2], np.float32)), "high"),
        (lambda c: c.update(B_11=np.zeros((4, 8, 8))), "B_11"),
        (lambda c: c.update(B_11=np.zeros((3, 8, 8), np.uint8)), "B_11"),
        (lambda c: c.update(frame_ids=np.array([{}], object)), "masks"),
        (lambda c: c.update(frame_ids=np.array([], str)), "frame_ids"),
    ],
)
def test_damaged_masks_are_refused(report_runs, tmp_path, damage, field):
    with np.load(report_runs / "explain/demo/masks_detect.npz") as file:
        content = dict(file)
    damage(content)
    np.savez(tmp_path / "masks.npz", **content)
    with pytest.raises(UserError) as raised:
        read_masks(tmp_path / "masks.npz")
    assert raised.value.field == field


def _explain(runs: Path) -> object:
    run = read_run(runs / "explain/demo", runs)
    assert run is not None
    return explanation_section(run, "key", "title")


def _detect(runs: Path) -> object:
    run = read_run(runs / "detect/demo", runs)
    assert run is not None
    return detection_section([run], None)


def _navigate(runs: Path) -> object:
    run = read_run(runs / "navigate/demo-stack", runs)
    assert run is not None
    return navigation_section([run], None)


@pytest.mark.parametrize(
    ("read", "name", "content"),
    [
        (_explain, "explain/demo/claims.json", "{"),
        (_explain, "explain/demo/claims.json", '["a"]'),
        (_explain, "explain/demo/captions.json", "[]"),
        (_explain, "explain/demo/pcc_detect.png", "no picture"),
        (_detect, "detect/demo/precision_recall.parquet", "no table"),
        (_detect, "detect/demo/inputs.json", "[]"),
        (_detect, "detect/demo/metrics.json", "["),
        (_navigate, "navigate/demo-stack/errors.parquet", "no table"),
    ],
)
def test_a_damaged_file_is_named_in_one_line(report_runs, tmp_path, read, name, content):
    runs = Path(shutil.copytree(report_runs, tmp_path / "runs"))
    (runs / name).write_text(content)
    with pytest.raises(UserError, match=Path(name).name) as raised:
        read(runs)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("column", "value"), [("x0_px", np.nan), ("x1_px", np.inf), ("score", np.inf), ("score", "high")]
)
def test_detections_that_are_no_finite_numbers_are_refused(report_data, report_runs, tmp_path, column, value):
    run = Path(shutil.copytree(report_runs / "detect/demo", tmp_path / "demo"))
    table = pd.read_parquet(run / "detections.parquet").assign(**{column: value})
    table.to_parquet(run / "detections.parquet")
    with pytest.raises(UserError, match=rf"detections\.parquet: {column}: got .*, expected finite numbers"):
        read_detections(run, str(report_data / "detect"))


def half(path: Path) -> None:
    """Truncate a file to its first half."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    "name", ["runs/explain/demo/pcc_detect.png", "data/detect/frames/s004/t004/000001.png"], ids=["picture", "frame"]
)
def test_half_a_png_is_named_in_one_line(report_data, report_runs, tmp_path, name):
    for folder, own in (("data", report_data), ("runs", report_runs)):
        shutil.copytree(own, tmp_path / folder)
    half(tmp_path / name)
    given = ["--dataset", tmp_path / "data", "--runs", tmp_path / "runs", "--out", tmp_path / "out"]
    done = report_command("--name", "demo", *given)
    # A progress bar may be above the line of the error.
    assert done.returncode == 2 and "Traceback" not in done.stderr
    (line,) = (line for line in done.stderr.splitlines() if line.startswith("error: "))
    assert Path(name).name in line and not (tmp_path / "out").exists()


def test_a_damaged_file_leaves_no_report(report_data, report_runs, tmp_path):
    runs = Path(shutil.copytree(report_runs, tmp_path / "runs"))
    (runs / "detect/demo/detections.parquet").write_text("no table")
    with pytest.raises(UserError, match=r"detections\.parquet"):
        write_report("demo", "demo", report_data, runs, tmp_path / "out")
    assert not (tmp_path / "out").exists()
