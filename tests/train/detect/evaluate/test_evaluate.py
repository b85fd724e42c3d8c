"""The commands evaluate and compare over a finished run, and what wrong input gets."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from tests.train.detect.evaluate.coco_reference import coco_evaluation
from typer.testing import CliRunner

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import app
from perilune_train.detect.config import LabelSettings
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import COCO_IOUS, Detections, find_overlaps
from perilune_train.detect.evaluate.metrics import curve


@pytest.fixture(scope="session")
def run(finished) -> Path:
    return finished.root


def call(*arguments):
    """Run `perilune-train detect ...`; a user's error is raised."""
    result = CliRunner().invoke(app, ["detect", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def figures(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_a_run_evaluated_again_has_the_same_figures(run, dataset_detect):
    before = (run / "metrics.json").read_bytes()
    call("evaluate", "--run", run, "--dataset", dataset_detect)
    assert (run / "metrics.json").read_bytes() == before
    first, again = figures(run), figures(run / "evaluation")
    for key, value in again.items():
        if key != "test/images_per_s":
            assert value == first[key], key
    assert again["dataset/protocol"] == "held-out scenes"
    assert (again["test/intervals_over"], again["test/intervals_units"]) == ("trajectory", 1)
    # One test trajectory: its own value, and no interval. Its curve has at most 2000 points.
    assert again["test/ap50_paper_interval"] is None
    own = [value for key, value in again.items() if key.startswith("test/ap50_paper/by_trajectory/")]
    assert own == pytest.approx([again["test/ap50_paper"]], abs=1e-5)
    assert again["test/strict/ap50_paper"] <= again["test/edge/ap50_paper"] <= again["test/ap50_paper"]
    assert again["test/edge/recall"] == again["test/recall"]
    for name in ("report.md", "precision_recall.png", "bins.png", "detections.png", "detections.parquet"):
        assert (run / "evaluation" / name).stat().st_size > 0, name


@pytest.mark.usefixtures("no_pictures")
def test_other_labels_another_threshold_another_split(run, dataset_detect, tmp_path):
    call("evaluate", "--run", run, "--dataset", dataset_detect, "--split", "val", "--threshold", 0.3, "--out", tmp_path)
    plain = figures(tmp_path)
    assert plain["val/threshold"] == 0.3 and plain["labels/selection"] == "visible"
    assert "given on the command line" in (tmp_path / "report.md").read_text()
    everything = ("--set", "detect.labels.selection=paper", "--set", "detect.evaluation.max_detections=7")
    call("evaluate", "--run", run, "--dataset", dataset_detect, "--split", "val", *everything, "--out", tmp_path)
    assert figures(tmp_path)["labels/min_contrast"] is None
    assert figures(tmp_path)["val/labels"] > plain["val/labels"]
    assert "most detections in one frame: 7" in (tmp_path / "report.md").read_text()


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_other_scales_and_a_threshold_of_their_own(run, dataset_detect, tmp_path):
    evaluate_run = ("evaluate", "--run", run, "--dataset", dataset_detect, "--scale", 1, "--scale", 2)
    call(*evaluate_run, "--out", tmp_path / "own")
    call(*evaluate_run, "--choose-threshold", "--out", tmp_path / "chosen")
    call(*evaluate_run, "--split", "val", "--out", tmp_path / "val")
    own, chosen, val = (figures(tmp_path / name) for name in ("own", "chosen", "val"))
    assert own["test/threshold"] == figures(run)["test/threshold"]
    assert own["test/ap50_paper"] == chosen["test/ap50_paper"] != figures(run)["test/ap50_paper"]
    assert own["evaluation/scales"] == "1 2" and figures(run)["evaluation/scales"] == "1"
    assert "of highest F1 on val of the dataset" in (tmp_path / "chosen/report.md").read_text()
    assert "evaluated at scale 1 and 2" in (tmp_path / "chosen/report.md").read_text()
    table = call("compare", run, tmp_path / "chosen", "--out", tmp_path / "both")
    assert "| 1 |" in table and "| 1 2 |" in table
    # The threshold is the best on val, by the same detections that --split val finds.
    call(*evaluate_run, "--split", "val", "--threshold", chosen["test/threshold"], "--out", tmp_path / "best")
    assert figures(tmp_path / "best")["val/f1"] >= val["val/f1"]
    # Another operating point on the same val: the message, the required precision, and no less recall.
    required = ("--set", f"detect.evaluation.min_precision={val['val/precision'] / 2}")
    call(*evaluate_run, "--choose-threshold", *required, "--out", tmp_path / "recall")
    assert "of highest recall at a precision of at least" in (tmp_path / "recall/report.md").read_text()
    more = figures(tmp_path / "recall")
    assert more["test/threshold"] != own["test/threshold"]
    call(*evaluate_run, "--split", "val", "--threshold", more["test/threshold"], "--out", tmp_path / "val-recall")
    assert figures(tmp_path / "val-recall")["val/precision"] >= val["val/precision"] / 2
    assert figures(tmp_path / "val-recall")["val/recall"] >= val["val/recall"]
    for other in (("--threshold", 0.5), ("--split", "val"), ("--images", tmp_path)):
        with pytest.raises(UserError, match="--choose-threshold: options"):
            call("evaluate", "--run", run, "--choose-threshold", *other)


def test_figures_of_another_definition_are_not_put_beside(tmp_path):
    """Runs evaluated earlier have the interpolated AP under the key ap50."""
    (tmp_path / "metrics.json").write_text(json.dumps({"test/ap50": 0.9, "test/f1": 0.8}))
    with pytest.raises(UserError, match=r"metrics\.json: ap50: .*ap50_paper"):
        call("compare", tmp_path, "--out", tmp_path / "both")
    assert not (tmp_path / "both").exists()


@pytest.mark.usefixtures("no_pictures")
def test_runs_side_by_side(run, dataset_detect, tmp_path):
    call("evaluate", "--run", run, "--dataset", dataset_detect, "--out", tmp_path / "b")
    text = call("compare", run, tmp_path / "b", "--out", tmp_path / "both")
    written = (tmp_path / "both/compare.md").read_text()
    rows = [line for line in written.splitlines() if line.startswith("| ")][2:]
    assert len(rows) == 2 and all(row in text for row in rows)
    assert rows[0].split("|")[2:] == rows[1].split("|")[2:]
    assert "held-out scenes" in rows[0] and f"{figures(run)['test/ap50_paper']:.3f}" in rows[0]
    assert (tmp_path / "both/precision_recall.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--split", "tset"], "--split: got tset, expected one of train, val, test"),
        (["--threshold", "2"], "--threshold: got 2.0, expected a number from 0 to 1"),
        (["--set", "detect.width=1"], "--set: detect.width: got not a setting of the evaluation"),
        (["--set", "detect.evaluation.match_iuo=0.4"], "got an unknown key, expected match_iou"),
        (["--out", "."], "the run's own folder"),
        (["--scale", "9"], "--scale: detect.evaluation.scales.0: got 9.0, expected"),
        (["--scale", "nan"], "--scale: detect.evaluation.scales.0"),
        (["--tile", "256"], "--tile: options: got no --images, expected --images, or no --tile"),
        (["--overlap", "32"], "--overlap: options: got no --images"),
        (["--box-margin", "0.5"], "--box-margin: options: got no --images"),
        (["--min-size", "8"], "--min-size: options: got no --images"),
    ],
)
def test_wrong_options_in_one_line(run, dataset_detect, options, message, monkeypatch):
    monkeypatch.chdir(run)
    with pytest.raises(UserError) as error:
        call("evaluate", "--run", run, "--dataset", dataset_detect, *options)
    assert message in str(error.value)


def test_folders_that_are_no_finished_runs(run, dataset_detect, tmp_path):
    with pytest.raises(UserError, match=r"run: got a folder without config.yaml, expected a detect run; train one: "):
        call("evaluate", "--run", tmp_path, "--dataset", dataset_detect)
    with pytest.raises(UserError, match=r"metrics.json: metrics: got no such file"):
        call("compare", run, tmp_path, "--out", tmp_path / "out")
    (tmp_path / "metrics.json").write_text("[1, 2]")
    with pytest.raises(UserError, match="expected a flat JSON object"):
        call("compare", tmp_path, "--out", tmp_path / "out")
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(UserError, match=r"precision_recall.parquet: file: got no such file"):
        call("compare", tmp_path, "--out", tmp_path / "out")
    (tmp_path / "precision_recall.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(UserError, match="expected a complete Parquet file with table of a run"):
        call("compare", tmp_path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_networks_detections_by_pycocotools(run, dataset_detect):
    split = load_split(open_dataset(dataset_detect), "test", LabelSettings(selection="paper"))
    table = pq.read_table(run / "detections.parquet").to_pandas()
    found, labels = [], []
    for frame, part in zip(split.frames.table["frame_id"], split.labels, strict=True):
        own = table[table["frame_id"] == frame]
        found.append(Detections(own[["x0_px", "y0_px", "x1_px", "y1_px"]].to_numpy(), own["score"].to_numpy()))
        kept = part.selected
        labels.append(FrameLabels(part.boxes[kept], part.radius_px[kept], part.ellipses[kept], kept[kept], kept[kept]))
    overlaps = find_overlaps(found, labels, facts_of(split.frames).sizes_px)
    # COCO knows nothing of centres off the image.
    overlaps = replace(overlaps, off_image=np.zeros(len(overlaps.scores), bool))
    curves = [curve(overlaps.match(iou, (0.0, 1e9))) for iou in COCO_IOUS]
    by_101, by_all = coco_evaluation(found, labels)
    assert len(table) > 100 and by_all[0] > 0
    np.testing.assert_allclose([points.ap_coco101() for points in curves], by_101, atol=1e-6)
    np.testing.assert_allclose([points.ap_envelope() for points in curves], by_all, atol=1e-6)
