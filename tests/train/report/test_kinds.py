"""Reports of the paper's experiment and of the locked benchmark."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.content import Report, Section
from perilune_train.report.page import gather, html_of
from perilune_train.report.paper.runs import DETECTORS, EXPLAINED, NAVIGATORS


def section(report: Report, key: str) -> Section:
    (found,) = (one for one in report.sections if one.key == key)
    return found


def picture(path: Path) -> None:
    Image.fromarray(np.zeros((30, 50, 3), np.uint8)).save(path)


@pytest.fixture
def data(report_data, tmp_path) -> Path:
    """Folder of the datasets, without navigation."""
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "detect").symlink_to(report_data / "detect")
    return folder


def test_the_papers_experiment(data, report_runs, tmp_path):
    root = tmp_path / "runs" / "paper"
    for name in DETECTORS.values():
        shutil.copytree(report_runs / "detect/demo", root / "detect" / name)
    for name in NAVIGATORS.values():
        shutil.copytree(report_runs / "navigate/demo-stack", root / "navigate" / f"{name}-stack")
    shutil.copytree(report_runs / "explain/demo", root / "explain" / EXPLAINED)
    verdict = {"verdict/1/claim": "attention is better", "verdict/1/measured": "0.9", "verdict/1/answer": "holds"}
    write_metrics(root, verdict, "paper.json")
    picture(root / "learning.png")
    report = gather("paper", "paper", data, root)
    page = section(report, "paper")
    assert page.lead == ("Claims of the paper: 1; holds: 1.",)
    assert page.tables[0].rows == (("attention is better", "0.9", "holds"),) and len(page.figures) == 1
    detection = section(report, "detection")
    assert detection.tables[0].head == ("figure", "yolov3", "attention-yolov3")
    assert detection.tables[0].rows[0][:2] == ("AP", "0.750")
    assert [own.source for own in detection.figures[0].sources] == ["detect/yolov3", "detect/attention-yolov3"]
    assert {own.source for own in report.provenance} >= {"navigate/darknet53-lstm-stack", "explain/attention"}
    assert report.viewer is not None and len(report.viewer.masks) == 2


def test_the_locked_benchmark(data, tmp_path):
    (data / "detect").rename(data / "benchmark-detect-highland")
    scores = tmp_path / "runs" / "benchmark"
    found = {"visible/ap50_paper": 0.9, "visible/ap50_paper_low": 0.8, "visible/ap50_paper_high": 0.95}
    found |= {"visible/intervals_units": 22, "visible/intervals_over": "scene", "visible/radius_2_3_px/ap50_paper": 0.4}
    write_metrics(scores / "ours", found, "benchmark.json")
    (scores / "ours" / "visible").mkdir()
    picture(scores / "ours" / "visible" / "detections.png")
    moved = {"warp/position_rmse_vector_m": 1.5, "warp/orientation_rmse_angle_deg": 0.1, "headline/method": "warp"}
    write_metrics(scores / "ours-navigate", moved, "benchmark.json")
    write_metrics(scores / "ours-landing", {"fix/position_rmse_m": 3.0, "fix/attitude_rmse_deg": 0.2}, "benchmark.json")
    report = gather("benchmark", "benchmark", data, tmp_path / "runs")
    detection = section(report, "benchmark-detection")
    assert detection.tables[0].rows[0] == ("AP", "0.900 (0.800 to 0.950)")
    assert "95 % intervals over 22 scenes" in detection.lead[-1]
    assert detection.figures[-1].caption.startswith("ours: best")
    navigation = section(report, "benchmark-navigation")
    assert navigation.tables[0].rows == (
        ("fix", "ours-landing", "3.000", "0.200"),
        ("warp", "ours-navigate", "1.500", "0.100"),
    )
    assert report.missing == () and "Locked benchmark: benchmark" in html_of(report)
