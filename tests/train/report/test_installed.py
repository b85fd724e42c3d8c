"""The installed detector and the filter's landing beside networks that were just trained."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pytest
from tests.train.report.conftest import make_data, make_runs

from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.content import Report
from perilune_train.report.page import gather


@pytest.fixture
def shown(tmp_path) -> tuple[Path, Path]:
    """Data and runs of a demo with an evaluation of the installed detector and flights of the filter."""
    data = make_data(tmp_path / "data")
    runs = make_runs(tmp_path / "runs", data)
    trained, installed = runs / "detect" / "demo", runs / "detect" / "demo-installed"
    installed.mkdir()
    # Without the false detections of the trained network.
    found = pd.read_parquet(trained / "detections.parquet")
    found[found["score"] == 0.9].to_parquet(installed / "detections.parquet")
    figures = {f"test/{key}": 0.9 for key in ("ap50_paper", "precision", "recall", "f1")}
    write_metrics(installed, {**figures, "test/threshold": 0.5})
    landing = runs / "navigate" / "demo-landing"
    landing.mkdir()
    rows = pd.DataFrame({"scene_id": "s004", "trajectory_id": "t004", "draw": 0, "time_s": [0.0, 1.0]})
    rows = rows.assign(status="tracking", error_m=[2.0, 0.5], turn_deg=0.1, squared=[5.0, 6.0])
    rows.to_parquet(landing / "draws.parquet")
    return data, runs


def scores_of(report: Report) -> set[float]:
    """Scores of the detections on the frames of the viewer."""
    assert report.viewer is not None
    return {mark.shape[4] for frame in report.viewer.frames for mark in frame.detections}


def test_the_frames_are_those_of_the_installed_detector(shown):
    report = gather("demo", "demo", *shown)
    assert scores_of(report) == {0.9}
    assert "The installed detector finds 90 % of the labelled craters" in report.summary[1]
    section = next(section for section in report.sections if section.key == "detection")
    assert any("is the installed detector" in line for line in section.lead)


def test_without_the_installed_detector_the_frames_are_those_of_the_run(shown):
    data, runs = shown
    shutil.rmtree(runs / "detect" / "demo-installed")
    report = gather("demo", "demo", data, runs)
    assert scores_of(report) == {0.8, 0.9}
    assert "detect run demo-installed: no finished run" in report.missing


def test_the_landing_is_a_headline(shown):
    lines = gather("demo", "demo", *shown).summary
    assert any("position error of 1.458 m over the test descents, and of 0.500 m at their end" in x for x in lines)


def test_tiny_says_what_it_is_for(shown, monkeypatch):
    data, runs = shown
    assert gather("demo", "demo", data, runs).summary[0].startswith("The preset tiny only shows that all steps work")
    monkeypatch.setattr("perilune_train.report.page._TRIAL_PRESET", "another")
    assert not any("only shows that all steps work" in line for line in gather("demo", "demo", data, runs).summary)


def test_the_report_names_the_start_of_a_training(shown):
    data, runs = shown
    path = runs / "detect" / "demo" / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"train/start": "crater-detector", "train/epochs": 1}))
    path = runs / "navigate" / "demo-stack" / "metrics.json"
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"network/backbone": "from runs/navigate/a/checkpoints/best.ckpt"})
    )
    leads = [line for section in gather("demo", "demo", data, runs).sections for line in section.lead]
    assert "demo started from crater-detector; epochs of training on this dataset: 1." in leads
    assert "demo-stack started from runs/navigate/a/checkpoints/best.ckpt." in leads
