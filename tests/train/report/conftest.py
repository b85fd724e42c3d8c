"""Datasets and runs with known content for the tests of the report."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer
from PIL import Image
from tests.helpers import in_process
from tests.helpers.drawn_dataset import build_dataset

from perilune_shared.config.resolve import to_yaml
from perilune_shared.console.command_line import run_command_line
from perilune_shared.dataset.manifest import open_dataset
from perilune_train.cli.report import report as report_of_command_line
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.split_evaluation import write_detections
from perilune_train.detect.finished_run import chosen_threshold, config_of_run
from perilune_train.detect.inference.detector import open_run
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.records.metrics_file import write_metrics
from perilune_train.report.content import Report
from perilune_train.report.page import SUMMARY, gather, html_of
from perilune_train.report.sources import AnswerInputs
from perilune_train.report.summary import summary_of
from perilune_train.shipped.models import shipped_run

HOSTILE = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>\"'\\]]>\u2028$x$ &amp;"
"""A name that runs code wherever it is not escaped, and that matplotlib reads as mathematics."""
BLOCKS = {"B_11": 48, "B_31": 12}
"""Gates of the masks, and the side of their masks, pixels."""
HEADLINE = "the mask of B_11 follows craters: holds (detector); removing what it marks hurts 4.1 times as much: holds."
METHODS = ("stack", "klt", "nominal")


def make_runs(root: Path, data: Path, hostile: str = "") -> Path:
    """Write a detect, a navigate and an explain run of the name `demo`; detections are the labels themselves.

    Every second label is found, moved by 1 px; one detection of each frame is false. `hostile` is added to all texts.
    """
    dataset = open_dataset(str(data / "detect"))
    test = dataset.table("frames", ["frame_id"], split="test")["frame_id"].to_pylist()
    labels = dataset.table("labels", split="test").to_pandas()
    boxes = labels[[f"bbox_{name}_px" for name in ("x0", "y0", "x1", "y1")]].iloc[::2].to_numpy(np.float64) + 1.0
    found = pd.DataFrame(boxes, columns=["x0_px", "y0_px", "x1_px", "y1_px"])
    found = found.assign(frame_id=labels["frame_id"].iloc[::2].to_numpy(), score=0.9)
    false = pd.DataFrame({"x0_px": 1.0, "y0_px": 2.0, "x1_px": 41.0, "y1_px": 12.0, "frame_id": test, "score": 0.8})
    detect = root / "detect" / "demo"
    detect.mkdir(parents=True)
    (detect / "config.yaml").write_text(to_yaml("detect", DetectConfig()) + f"# {hostile}".splitlines()[0] + "\n")
    (detect / "inputs.json").write_text(json.dumps({"dataset": "ab" * 32, "teacher": None}))
    pd.concat([found, false]).to_parquet(detect / "detections.parquet")
    recall = np.linspace(0, 1, 20)
    pd.DataFrame({"score": 1 - recall, "precision": 1 - recall**2, "recall": recall}).to_parquet(
        detect / "precision_recall.parquet"
    )
    metrics = {"test/threshold": 0.5, "test/intervals_over": "scene", "test/intervals_units": 1}
    metrics |= {f"test/{key}": 0.75 for key in ("ap50_paper", "precision", "recall", "f1")}
    metrics |= {"test/radius_2_3_px/ap50_paper": 0.25, "test/radius_3_5_px/ap50_paper": 0.5}
    write_metrics(detect, metrics)
    navigate = root / "navigate" / "demo-stack"
    navigate.mkdir(parents=True)
    nav = open_dataset(str(data / "nav")).table("frames", split="test").to_pandas().sort_values("frame_index")
    steps = np.arange(len(nav) - 1)
    rows = pd.DataFrame({"step": steps, "altitude_m": 1400.0 - 100 * steps, "scene_id": nav["scene_id"].iloc[0]})
    rows = rows.assign(trajectory_id=nav["trajectory_id"].iloc[0], position_error_m=2.0, orientation_error_deg=0.1)
    rows = rows.assign(drift_m=1.0 + steps, drift_x_m=1.0 + steps, drift_y_m=0.0, drift_z_m=0.0)
    pd.concat([rows.assign(method=name + hostile) for name in METHODS]).to_parquet(navigate / "errors.parquet")
    errors = {"test/position_rmse_vector_m": 2.0, "test/orientation_rmse_angle_deg": 0.1}
    errors |= {"evaluation/method": "stack" + hostile, f"baseline/klt{hostile}/drift_final_m": 3.0}
    write_metrics(navigate, errors)
    explain = root / "explain" / "demo"
    explain.mkdir(parents=True)
    write_metrics(explain, {"frames": 4, "headline": HEADLINE + hostile})
    Image.fromarray(np.zeros((40, 2000, 3), np.uint8)).save(explain / "pcc_detect.png")
    claims = [
        {"claim": f"gates see craters {hostile}", "figure": "0.3", "verdict": "holds", "picture": "pcc_detect.png"}
    ]
    (explain / "claims.json").write_text(json.dumps(claims))
    (explain / "captions.json").write_text(json.dumps({"pcc_detect.png": f"bars with nulls {hostile}"}))
    masks = {name: np.full((len(test), side, side), 255, np.uint8) for name, side in BLOCKS.items()}
    for own in masks.values():
        own[:, :, : own.shape[2] // 2] = 0
    limits = {"low": np.zeros(2, np.float32), "high": np.full(2, 2.0, np.float32)}
    np.savez(explain / "masks_detect.npz", frame_ids=np.array(test), blocks=np.array(list(BLOCKS)), **limits, **masks)
    return root


def make_data(root: Path) -> Path:
    """Write a detection and a navigation dataset of 96 px with 4 frames each descent."""
    build_dataset(root / "detect", "detect", n_frames=4)
    build_dataset(root / "nav", "nav", splits={"train": 1, "val": 1, "test": 1}, scenes=1, n_frames=4)
    return root


def report_command(*arguments: object):
    """Call `perilune-train report` in this process."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(report_of_command_line)
    return in_process.call(lambda: run_command_line(app), *arguments)


@pytest.fixture(scope="session")
def report_data(tmp_path_factory) -> Path:
    """Datasets `detect` and `nav`. Read only."""
    return make_data(tmp_path_factory.mktemp("report") / "data")


@pytest.fixture(scope="session")
def report_runs(report_data, tmp_path_factory) -> Path:
    """Runs of the name `demo`. Read only: copy before a change."""
    return make_runs(tmp_path_factory.mktemp("report") / "runs", report_data)


@pytest.fixture(scope="session")
def report(report_data, report_runs) -> Report:
    """The content of the report of the runs."""
    return gather("demo", "demo", report_data, report_runs)


@pytest.fixture(scope="session")
def page(report, tmp_path_factory) -> Path:
    """The page of the report."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(html_of(report), encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def hostile_page(report_data, tmp_path_factory) -> Path:
    """A report in which every text that comes from a file is HOSTILE: runs, claims, names of frames.

    Reading a dataset refuses such names and recipes, so they are put in afterwards.
    """
    root = tmp_path_factory.mktemp("hostile")
    report = gather("demo", "demo", report_data, make_runs(root / "runs", report_data, HOSTILE))
    assert report.viewer is not None
    frames = tuple(replace(frame, name=HOSTILE + frame.name) for frame in report.viewer.frames)
    masks = tuple(replace(mask, block=HOSTILE) for mask in report.viewer.masks)
    viewer = replace(report.viewer, trajectory=HOSTILE, frames=frames, masks=masks)
    report = replace(report, title=HOSTILE, missing=(HOSTILE,), viewer=viewer)
    (root / "report.html").write_text(html_of(report), encoding="utf-8")
    (root / SUMMARY).write_text(summary_of(report), encoding="utf-8")
    return root / "report.html"


CHANGED = range(0, 40, 2)
"""Craters that the counterfactual datasets change: large ones of scene s004."""


@dataclass(frozen=True)
class Answered:
    """A report with answers of the installed detector."""

    data: Path
    """Folder of the datasets."""
    runs: Path
    """Folder of the runs; detect/demo-installed has the detections of the installed detector."""
    inputs: AnswerInputs
    """Datasets of changed frames."""
    report: Report
    """The content of the report."""
    page: Path
    """The page."""


@pytest.fixture(scope="session")
def answered(report_data, report_runs, tmp_path_factory) -> Answered:
    """A report with answers on six detections. Read only."""
    root = tmp_path_factory.mktemp("answered")
    runs = Path(shutil.copytree(report_runs, root / "runs"))
    detected_by_the_installed_detector(runs / "detect/demo-installed", report_data / "detect")
    removed = {"s004": CHANGED}
    for name, options in (
        ("without", {"removed": removed}),
        ("half", {"removed": removed, "depth_share": 0.5}),
        ("turned", {"sun_offset_deg": 40.0}),
    ):
        build_dataset(root / name, "detect", n_frames=4, **options)
        table = pd.DataFrame({"scene_id": "s004", "crater_id": list(CHANGED), "depth_ratio": 0.15})
        table.to_parquet(root / f"{name}.removed.parquet")
    inputs = AnswerInputs(6, str(root / "without"), str(root / "half"), str(root / "turned"))
    report = gather("demo", "demo", report_data, runs, inputs)
    path = root / "report.html"
    path.write_text(html_of(report), encoding="utf-8")
    return Answered(report_data, runs, inputs, report, path)


def detected_by_the_installed_detector(folder: Path, data: Path) -> None:
    """Write what an evaluation of the installed detector writes and the report reads."""
    trained = shipped_run("detect")
    config = config_of_run(trained)
    split = load_split(open_dataset(str(data)), "test", config.labels)
    folder.mkdir()
    write_detections(
        folder / "detections.parquet", split, detect_at_scales(open_run(trained, config), split.frames.images)
    )
    figures = {f"test/{key}": 0.9 for key in ("ap50_paper", "precision", "recall", "f1")}
    write_metrics(folder, {**figures, "test/threshold": chosen_threshold(trained)})
