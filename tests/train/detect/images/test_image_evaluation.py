"""Evaluation on labelled images: expected figures, ignored craters, files written to the folder."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.helpers.stored_run import THRESHOLD, settings_of, store_run
from typer.testing import CliRunner

from perilune_shared.errors import UserError
from perilune_train.cli.main import app
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.evaluate_runs import compare_folders
from perilune_train.detect.images.evaluate import ImageSettings, evaluate_detections_in_images, evaluate_images
from perilune_train.detect.images.labelled import ImageSet, LabelledImage, read_images
from perilune_train.detect.inference.tiling import Tiling


def given(boxes, clipped=False):
    boxes = np.array(boxes, float)
    return ImageSet([LabelledImage("a.png", Path("a.png"), 100, 100, boxes, np.ones(len(boxes), bool))], clipped)


def detections(boxes):
    return [Detections(np.array(boxes, float), np.linspace(0.9, 0.5, len(boxes)))]


@pytest.mark.parametrize(
    ("found", "precision", "recall"),
    [
        # The expected one alone; then with finds of what is ignored, which change nothing.
        ([[10, 10, 20, 20]], 1.0, 1.0),
        ([[10, 10, 20, 20], [50, 50, 57, 57], [96, 10, 116, 30]], 1.0, 1.0),
        # Small ones that find nothing do not count, large ones are false.
        ([[10, 10, 20, 20], [70, 70, 77.9, 77.9]], 1.0, 1.0),
        ([[10, 10, 20, 20], [70, 70, 78.1, 78.1]], 0.5, 1.0),
        ([[70, 70, 90, 90]], 0.0, 0.0),
    ],
)
def test_small_and_outer_craters_do_not_count(found, precision, recall):
    # 10 px expected, 7 px too small, the third centred off the image.
    images = given([[10, 10, 20, 20], [50, 50, 57, 57], [96, 10, 116, 30]])
    figures = evaluate_detections_in_images(images, detections(found), 0.1, 8.0).figures()
    assert (figures["precision"], figures["recall"], figures["labels"]) == (precision, recall, 1)


def test_detections_end_at_the_edges_where_boxes_do():
    cut, whole = [[90, 40, 100, 60]], [[90, 40, 130, 60]]
    assert evaluate_detections_in_images(given(cut, True), detections(whole), 0.1, 8.0).figures()["recall"] == 1
    assert evaluate_detections_in_images(given(cut, False), detections(whole), 0.1, 8.0).figures()["recall"] == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return store_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "images"
    root.mkdir()
    rng = np.random.default_rng(0)
    for name, (width, height) in {"a": (96, 64), "b": (70, 80)}.items():
        Image.fromarray(rng.integers(0, 256, (height, width), np.uint8)).save(root / f"{name}.png")
        rows = "".join(f"{k},{x},{y},{s},{s},0,0\n" for k, (x, y, s) in enumerate(rng.integers(5, 40, (30, 3))))
        (root / f"{name}.txt").write_text("ID,X,Y,W,H,C_X,CY\n" + rows)
    return root


def test_a_folder_is_evaluated(run, folder, tmp_path):
    out = tmp_path / "out"
    figures = evaluate_images(run, settings_of(run), folder, out, ImageSettings(Tiling(tile_px=96, overlap_px=32)))
    written = json.loads((out / "metrics.json").read_text())
    assert written["threshold"] == THRESHOLD and written["frames"] == 2
    expected = [image.selected(8.0).sum() for image in read_images(folder).images]
    assert written["labels"] == sum(expected) > 40
    assert 0 < written["ap50_paper"] < 1 and written["oracle/f1"] >= written["f1"] > 0
    assert written["ap50_paper"] == pytest.approx(figures["ap50_paper"])
    for name in ("report.md", "precision_recall.png", "detections.png", "detections.parquet", "crops.png"):
        assert (out / name).stat().st_size > 0, name
    assert "oracle" in (out / "report.md").read_text()
    # What is found does not hang on the least size, what is expected does.
    larger = evaluate_images(
        run, settings_of(run), folder, tmp_path / "larger", ImageSettings(Tiling(tile_px=96, overlap_px=32), 30.0, 0.5)
    )
    assert 0 < larger["labels"] < figures["labels"] and larger["threshold"] == 0.5


def test_nothing_is_written_for_a_fault(run, folder, tmp_path):
    for arguments in ((Tiling(), 0.0), (Tiling(), 1000.0), (Tiling(tile_px=5), 8.0)):
        with pytest.raises(UserError):
            evaluate_images(run, settings_of(run), folder, tmp_path / "out", ImageSettings(*arguments))
    (folder / "b.txt").write_text("X,Y,W,H\n1,2,3\n")
    with pytest.raises(UserError, match=r"b\.txt: line 2"):
        evaluate_images(run, settings_of(run), folder, tmp_path / "out", ImageSettings(Tiling()))
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_pictures")
def test_the_command(run, folder, tmp_path):
    arguments = ["detect", "evaluate", "--run", str(run), "--images", str(folder), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*arguments, "--scale", "0.5", "--min-size", "20", "--threshold", "0.02"])
    assert result.exit_code == 0, result.output
    written = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (written["scales"], written["min_size_px"], written["threshold"]) == ("0.5", 20, 0.02)
    for option, value, message in (
        ("--dataset", "data", "--dataset: options: got together with --images, expected only one of them"),
        ("--split", "test", "--split: got test, expected a source with splits; images has none"),
        ("--set", "detect.labels.selection=all", "--set: detect.labels.selection: got together with --images"),
        ("--scale", "9", "--scale: got [9.0]"),
    ):
        refused = CliRunner().invoke(app, [*arguments, option, value])
        assert isinstance(refused.exception, UserError) and message in str(refused.exception)


def test_the_runs_own_folder_keeps_its_figures(run, folder):
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    for out in (run, run / "checkpoints" / ".."):
        result = CliRunner().invoke(
            app, ["detect", "evaluate", "--run", str(run), "--images", str(folder), "--out", str(out)]
        )
        assert isinstance(result.exception, UserError) and "the run's own folder" in str(result.exception)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


@pytest.mark.usefixtures("no_pictures")
def test_compare_shows_images(run, folder, tmp_path):
    figures = evaluate_images(
        run, settings_of(run), folder, tmp_path / "a", ImageSettings(Tiling(96, 32, (0.5, 1.0)), 12.0)
    )
    text = compare_folders([tmp_path / "a"], tmp_path / "both")
    cells = [cell.strip() for cell in text.splitlines()[-1].strip("| ").split("|")]
    expected = ["images", "images", "-", "real images", "from 12.0 px", "0.5 1.0", "2", str(figures["labels"])]
    assert cells[1:9] == expected
    assert cells[9].startswith(f"{figures['ap50_paper']:.3f} (a.png ") and "-" not in cells[10:16]
    assert f"{figures['lowest_ap50_paper_by_radius']:.3f}" == cells[16]


@pytest.mark.usefixtures("no_pictures")
def test_scales_depend_on_the_run_and_the_image(folder, tmp_path):
    run = store_run(tmp_path / "runs", "evaluation.scales=[1,2]")
    arguments = ["detect", "evaluate", "--run", str(run), "--images", str(folder), "--out"]
    for name, given, expected in (("own", (), "2.0; 2.0 1.0"), ("other", ("--scale", "0.5"), "0.5")):
        result = CliRunner().invoke(app, [*arguments, str(tmp_path / name), *given])
        assert result.exit_code == 0, result.output
        assert json.loads((tmp_path / name / "metrics.json").read_text())["scales"] == expected
