"""COCO files, read by pycocotools; its evaluator gives perfect predictions an average precision of 1."""

import contextlib
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from rich.progress import Progress
from typer.testing import CliRunner

from perilune_shared.cli.main import app
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError
from perilune_shared.export.coco import area_of, clip_to_image, export_coco
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS

SMALLEST_PX = 4.0


def only_large(dataset, scene_id, labels):
    return pc.greater(labels["radius_px"], SMALLEST_PX).to_numpy(zero_copy_only=False)


def exported(root, out, **choice):
    with Progress(disable=True) as progress:
        export_coco(open_dataset(root), out, progress, **choice)
    return out


def quietly(function, *arguments):
    with contextlib.redirect_stdout(io.StringIO()):
        return function(*arguments)


@pytest.fixture(scope="module")
def all_labels(crowded, tmp_path_factory):
    return exported(crowded, tmp_path_factory.mktemp("coco") / "all")


@pytest.fixture(scope="module")
def with_choice(crowded, tmp_path_factory):
    return exported(crowded, tmp_path_factory.mktemp("coco") / "large", choose=only_large)


def average_precision(ground_truth: COCO, results: list[dict], kind: str) -> float:
    """Return the mean over IoU thresholds 0.5 to 0.95, with all predictions of an image, not only the first 100."""
    evaluation = COCOeval(ground_truth, quietly(ground_truth.loadRes, results), kind)
    evaluation.params.maxDets = [1, 10, 10_000]
    quietly(evaluation.evaluate)
    quietly(evaluation.accumulate)
    precision = evaluation.eval["precision"][:, :, 0, 0, -1]
    assert precision.shape == (10, 101)
    return float(precision.mean())


def perfect_predictions(ground_truth: COCO, *, crowd=False) -> list[dict]:
    return [
        {
            "image_id": a["image_id"],
            "category_id": 1,
            "bbox": a["bbox"],
            "segmentation": a["segmentation"],
            "score": 1.0,
        }
        for a in ground_truth.anns.values()
        if crowd or not a["iscrowd"]
    ]


@pytest.mark.parametrize("split", ["train", "val", "test"])
@pytest.mark.parametrize("kind", ["bbox", "segm"])
def test_perfect_predictions_have_an_ap_of_one(all_labels, split, kind):
    ground_truth = quietly(COCO, all_labels / f"instances_{split}.json")
    results = perfect_predictions(ground_truth)
    assert len(results) > 100
    assert average_precision(ground_truth, results, kind) == pytest.approx(1, abs=1e-12)


def test_shifted_predictions_have_a_lower_ap(all_labels):
    ground_truth = quietly(COCO, all_labels / "instances_test.json")
    moved = [
        {**result, "bbox": [result["bbox"][0] + 1, *result["bbox"][1:]]} for result in perfect_predictions(ground_truth)
    ]
    assert 0.1 < average_precision(ground_truth, moved, "bbox") < 0.9


def test_every_label_is_exported(crowded, all_labels):
    dataset = open_dataset(crowded)
    frames = {row["png_path"]: row for row in dataset.table("frames").to_pylist()}
    labels = {(row["frame_id"], row["crater_id"]): row for row in dataset.table("labels").to_pylist()}
    for split in ("train", "val", "test"):
        ground_truth = quietly(COCO, all_labels / f"instances_{split}.json")
        assert {i["file_name"] for i in ground_truth.imgs.values()} == {
            p for p, row in frames.items() if row["split"] == split
        }
        for annotation in ground_truth.anns.values():
            image = ground_truth.imgs[annotation["image_id"]]
            row = labels.pop((frames[image["file_name"]]["frame_id"], annotation["crater_id"]))
            x, y, w, h = annotation["bbox"]
            corners = [x, y, x + w, y + h]
            expected = [row[f"bbox_{name}_px"] for name in ("x0", "y0", "x1", "y1")]
            assert np.allclose(corners, np.clip(expected, 0, image["width"]), atol=2e-3)
            assert annotation["ellipse"][0] == pytest.approx(row["ellipse_cx_px"], abs=1e-6)
            assert annotation["visible_fraction"] == 1.0
    assert not labels


def test_masks_cover_the_ellipses(all_labels):
    """The mask from pycocotools has the area and the centre of the ellipse, in the pixels of perilune."""
    ground_truth = quietly(COCO, all_labels / "instances_train.json")
    checked, outline = 0, []
    for annotation in ground_truth.anns.values():
        cx, cy, a, b, _ = annotation["ellipse"]
        if a < 8 or min(cx, cy, 128 - cx, 128 - cy) < a + 1:
            continue
        rows, columns = np.nonzero(ground_truth.annToMask(annotation))
        assert len(rows) == pytest.approx(np.pi * a * b, rel=0.05)
        assert annotation["area"] == pytest.approx(np.pi * a * b, rel=1e-3)
        outline.append([columns.mean() + 0.5 - cx, rows.mean() + 0.5 - cy])
        checked += 1
    assert checked > 10
    assert np.abs(np.mean(outline, axis=0)).max() < 0.1


def test_unselected_craters_are_ignored(with_choice):
    ground_truth = quietly(COCO, with_choice / "instances_test.json")
    crowd = [a for a in ground_truth.anns.values() if a["iscrowd"]]
    assert 0 < len(crowd) < len(ground_truth.anns)
    assert max(np.sqrt(a["ellipse"][2] * a["ellipse"][3]) for a in crowd) <= SMALLEST_PX
    assert average_precision(ground_truth, perfect_predictions(ground_truth), "bbox") == pytest.approx(1, abs=1e-12)
    # Detecting them too does not change the result.
    assert average_precision(ground_truth, perfect_predictions(ground_truth, crowd=True), "bbox") == pytest.approx(
        1, abs=1e-12
    )


def test_numbers_do_not_depend_on_split_and_choice(crowded, all_labels, with_choice, tmp_path):
    one = exported(crowded, tmp_path / "one", split="test")
    assert [path.name for path in one.iterdir()] == ["instances_test.json"]
    assert (one / "instances_test.json").read_bytes() == (all_labels / "instances_test.json").read_bytes()
    ids = [{a["id"]: a["bbox"] for a in json.loads((f / "instances_val.json").read_text())["annotations"]}
           for f in (all_labels, with_choice)]  # fmt: skip
    assert ids[0] == ids[1]
    every = [a["id"] for f in all_labels.iterdir() for a in json.loads(f.read_text())["annotations"]]
    assert sorted(every) == list(range(1, len(every) + 1))


def test_packed_frames_give_the_same_file(crowded_packed, all_labels, tmp_path):
    again = exported(crowded_packed, tmp_path / "packed")
    for path in all_labels.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()


def test_a_polygon_is_clipped_to_the_image():
    square = np.array([[-1.0, -1.0], [3.0, -1.0], [3.0, 3.0], [-1.0, 3.0]])
    cut = clip_to_image(square, 10, 2)
    assert area_of(cut) == pytest.approx(3 * 2) and cut.min() == 0 and cut.max(axis=0).tolist() == [3, 2]
    assert len(clip_to_image(square + 20, 10, 10)) == 0


def test_a_failed_export_leaves_no_files(crowded, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="new or empty"):
        exported(crowded, out)
    with pytest.raises(ZeroDivisionError):
        exported(crowded, tmp_path / "new", choose=lambda *_: 1 / 0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_a_path_outside_the_dataset_is_refused(crowded, tmp_path):
    root = Path(shutil.copytree(crowded, tmp_path / "set"))
    part = root / "manifest/frames/all.parquet"
    rows = pq.read_table(part).to_pylist()
    rows[3]["png_path"] = "../../etc/passwd"
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES["frames"]), part)
    with pytest.raises(UserError, match="inside the dataset"):
        exported(root, tmp_path / "coco")
    assert not (tmp_path / "coco").exists()


def test_a_named_selection(crowded, tmp_path):
    command = ["export", str(crowded), "--format", "coco", "--selection", "visible", "--out", str(tmp_path / "coco")]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    labels = read_labels(open_dataset(crowded), split="train")
    expected = selected(labels, SELECTIONS["visible"])
    annotations = json.loads((tmp_path / "coco/instances_train.json").read_text())["annotations"]
    assert 0 < sum(not each["iscrowd"] for each in annotations) == expected.sum() < len(labels) == len(annotations)
    with pytest.raises(UserError, match="visible"):
        CliRunner().invoke(app, [*command[:-3], "visibel", *command[-2:]], catch_exceptions=False)
