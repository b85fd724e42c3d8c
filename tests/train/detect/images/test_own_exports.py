"""perilune's own exports are evaluated as they lie, with COCO's figures."""

import contextlib
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from rich.progress import Progress
from tests.helpers.stored_run import store_run
from typer.testing import CliRunner

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.export.coco import export_coco
from perilune_shared.export.yolo import export_yolo
from perilune_train.cli.main import app

LEAST_PX = 4.0


def every_second(dataset, scene_id, labels):
    """Half of the labels: the others become crowds in COCO, and are omitted in YOLO."""
    return np.arange(len(labels)) % 2 == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return store_run(tmp_path_factory.mktemp("runs"))


def evaluated(run, source, out, *more):
    command = ["detect", "evaluate", "--run", str(run), "--images", str(source), "--out", str(out), "--tile", "96"]
    result = CliRunner().invoke(app, [*command, "--min-size", "0.001", *map(str, more)])
    assert result.exit_code == 0, result.exception
    return json.loads((out / "metrics.json").read_text())


def coco_ap(truth, table):
    """COCO's AP at IoU 0.5 of a table of detections, clipped at the edges as the labels are."""
    with contextlib.redirect_stdout(io.StringIO()):
        labels = COCO(truth)
        ids = {image["file_name"]: (image["id"], image["width"], image["height"]) for image in labels.imgs.values()}
        results = []
        for row in table.itertuples():
            number, width, height = ids[row.image]
            x0, x1 = np.clip([row.x0_px, row.x1_px], 0, width)
            y0, y1 = np.clip([row.y0_px, row.y1_px], 0, height)
            box = [x0, y0, x1 - x0, y1 - y0]
            results.append({"image_id": number, "category_id": 1, "bbox": box, "score": row.score})
        evaluation = COCOeval(labels, labels.loadRes(results), "bbox")
        evaluation.params.maxDets = [100_000]
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0, 1e10]], ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    return float(evaluation.eval["precision"][0, :, 0, 0, 0].mean())


@pytest.mark.usefixtures("no_pictures")
def test_coco_with_crowds_has_the_figures_of_pycocotools(run, few, tmp_path):
    with Progress(disable=True) as progress:
        export_coco(open_dataset(few), tmp_path / "coco", progress, choose=every_second)
    figures = evaluated(run, tmp_path / "coco", tmp_path / "out", "--image-folder", few)
    assert figures["images/split"] == "split test of test, train, val"
    content = json.loads((tmp_path / "coco" / "instances_test.json").read_text())
    assert figures["frames"] == len(content["images"]) == 2
    assert figures["labels"] == sum(not one["iscrowd"] for one in content["annotations"]) > 3
    table = pd.read_parquet(tmp_path / "out" / "detections.parquet")
    expected = coco_ap(tmp_path / "coco" / "instances_test.json", table)
    assert 0 < expected < 1 and figures["ap50_coco101"] == pytest.approx(expected, abs=1e-6)
    ours = evaluated(run, tmp_path / "coco", tmp_path / "train", "--image-folder", few, "--split", "train")
    assert ours["frames"] == 6
    command = ["detect", "evaluate", "--run", str(run), "--images"]
    missing = CliRunner().invoke(app, [*command, str(tmp_path / "coco"), "--out", str(tmp_path / "x")])
    assert "--image-folder names the folder of the pictures" in str(missing.exception)


@pytest.mark.usefixtures("no_pictures")
def test_coco_in_the_folder_of_its_dataset(run, few, tmp_path):
    root = Path(shutil.copytree(few, tmp_path / "set"))
    with Progress(disable=True) as progress:
        export_coco(open_dataset(root), root / "coco", progress, split="test")
    assert evaluated(run, root / "coco", tmp_path / "out")["frames"] == 2


@pytest.mark.usefixtures("no_pictures")
def test_yolo(run, few, tmp_path):
    with Progress(disable=True) as progress:
        export_yolo(open_dataset(few), tmp_path / "yolo", progress)
    figures = evaluated(run, tmp_path / "yolo", tmp_path / "out")
    lines = [path.read_text().count("\n") for path in sorted((tmp_path / "yolo" / "labels").rglob("*.txt"))]
    names = (tmp_path / "yolo" / "test.txt").read_text().split()
    assert figures["frames"] == len(names) == 2 and 0 < figures["labels"] < sum(lines)
    assert figures["images/split"] == "split test of train, val, test"
    again = evaluated(run, tmp_path / "yolo" / "test.txt", tmp_path / "list")
    assert again["ap50_paper"] == figures["ap50_paper"] and again["labels"] == figures["labels"]
