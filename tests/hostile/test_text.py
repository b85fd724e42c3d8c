"""Names of other people through the commands that print or write them: no markup, control character or formula.

The names are those of run folders, images, categories, methods and datasets, and the texts of metrics.json.
`tests/test_house.py` finds prints, pages and tables that bypass the functions of `perilune_shared.export.foreign_text`.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import perilune_train
from perilune_render.cli.main import main as render
from perilune_shared.cli.main import main as manifest
from perilune_train.cli.main import main as train
from perilune_train.detect.evaluate_runs import compare_folders as _  # noqa: F401  (loaded before the commands are forked)
from perilune_train.detect.images import predict as _predict  # noqa: F401
from tests.helpers.drawn_dataset import build_dataset
from tests.helpers.pages import shown
from tests.hostile.measured import Outcome, accepted, outcome, refused

SHIPPED = Path(perilune_train.__path__[0]) / "shipped"
EVIL = "<script>alert(1)<script>![x](http:evil) `|`**b** [y](javascript:z)"
"""A file name that is markup; without a slash, which no file name has."""
NAMES = {
    "markup": EVIL,
    "control characters": "a\x1b[31mred\x1b]0;title\x07\x9b2J",
    "line ends": "a\nerror: spoofed\r\n# heading",
    "marks of direction": "a\u202egnp.\u2066",
    "formula of a figure": "$\\frac$ $x^",
    "formula of a table": "=HYPERLINK(1)",
    "option of Rich": "[bold red]x[link=a]",
    "long": "n" * 200,
}
ELEMENTS = {
    "h1",
    "h2",
    "h3",
    "p",
    "ul",
    "li",
    "em",
    "strong",
    "code",
    "img",
    "table",
    "thead",
    "tbody",
    "tr",
    "th",
    "td",
}
"""All elements of our pages."""


def check_printed(ended: Outcome) -> None:
    """No control character and no spoofed line; fails on a traceback."""
    assert "Traceback" not in ended.output, ended.output[-3000:]
    assert all(sign.isprintable() or sign == "\n" for sign in ended.output), repr(ended.output[-2000:])
    assert not any(line.startswith("error: spoofed") for line in ended.output.splitlines())


def check_pages(folder: Path) -> None:
    """Pages of a folder have only our own elements, and refer only to files beside them; tables hold no formula."""
    pages = [*folder.rglob("*.md")]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        found = shown(text)
        assert set(found.names) <= ELEMENTS, (page, set(found.names) - ELEMENTS)
        assert all((page.parent / address).is_file() for address in found.addresses), found.addresses
        assert all(sign.isprintable() or sign == "\n" for sign in text)
        assert "heading" not in [line.strip("# ") for line in text.splitlines()]
    for path in folder.rglob("*.csv"):
        for text in path.read_text(encoding="utf-8").splitlines():
            assert not text.startswith(("=", "+", "-", "@", '"=')), text


def run_folder(root: Path, name: str, texts: str) -> Path:
    """An evaluation of detection named `name`, whose metrics have `texts` in place of every text."""
    folder = root / name
    folder.mkdir(parents=True)
    content = json.loads((SHIPPED / "crater-detector" / "metrics.json").read_text())
    content = {key: texts if isinstance(value, str) else value for key, value in content.items()}
    own = {"evaluation/split": "test", "test/ap50_paper": 0.5, "test/frames": texts, "terrain/status": "separate"}
    (folder / "metrics.json").write_text(json.dumps(content | own | {"terrain/mark": texts}))
    table = pd.DataFrame({"score": [0.9, 0.5], "precision": [1.0, 0.5], "recall": [0.2, 0.6]})
    table.to_parquet(folder / "precision_recall.parquet", index=False)
    return folder


def flight_folder(root: Path, name: str, texts: str) -> Path:
    """The same of navigation."""
    folder = root / name
    folder.mkdir(parents=True)
    own = {"evaluation/method": texts, "evaluation/split": "test", "dataset/name": texts, "dataset/protocol": texts}
    own |= {"terrain/status": texts, "terrain/mark": texts, "test/pairs": texts, "evaluation/target": texts}
    (folder / "metrics.json").write_text(json.dumps(own | {"test/position_rmse_vector_m": 1.0}))
    errors = {name: [0.5, 0.7] for name in ("position_error_m", "orientation_error_deg", "error_x_m")}
    errors |= {name: [0.5, 0.7] for name in ("error_y_m", "error_z_m")} | {"step": [0, 1]}
    pd.DataFrame({"method": [texts] * 2, **errors}).to_parquet(folder / "errors.parquet", index=False)
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_comparison_of_runs(tmp_path: Path, name: str) -> None:
    text = NAMES[name]
    for task, folder in (("detect", run_folder), ("navigate", flight_folder)):
        run = folder(tmp_path / task, NAMES[name], text)
        out = tmp_path / f"{task}-out"
        ended = outcome(f"compare {task}: {name}", train, task, "compare", run, "--out", out)
        check_printed(ended)
        assert ended.code == 0 or (task == "navigate" and ended.code == 2 and ended.error), ended.output[-2000:]
        check_pages(out)


def test_images(tmp_path: Path) -> None:
    """Images, run folder and output folder of such names."""
    scene = cv2.GaussianBlur(np.random.default_rng(0).normal(128, 60, (64, 64)), (0, 0), 3)
    grey = cv2.imencode(".png", np.clip(scene, 0, 255).astype(np.uint8))[1].tobytes()
    images = [tmp_path / f"{name}.png" for name in NAMES.values()]
    for image in images:
        image.write_bytes(grey)
    run, out = tmp_path / "runs" / EVIL, tmp_path / f"out {EVIL}"
    shutil.copytree(SHIPPED / "crater-detector", run)
    ended = accepted("predict", train, "detect", "predict", *images, "--run", run, "--out", out, "--threshold", 1e-6)
    check_printed(ended)
    check_pages(out)
    assert set(pq.read_table(out / "detections.parquet")["image"].to_pylist()) == {image.name for image in images}


def test_labelled_images(tmp_path: Path) -> None:
    """A COCO file whose images and categories have such names, evaluated by a run of such a name."""
    folder = tmp_path / EVIL
    folder.mkdir()
    grey = np.random.default_rng(0).normal(128, 30, (64, 64)).clip(0, 255).astype(np.uint8)
    categories, images, annotations = [{"id": 0, "name": "crater"}, {"id": -1, "name": "craters"}], [], []
    for number, name in enumerate(NAMES.values(), 1):
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", grey)[1].tobytes())
        categories.append({"id": number, "name": name})
        images.append({"id": number, "file_name": f"{name}.png"})
        annotations.append({"image_id": number, "category_id": 0, "bbox": [10, 10, 30, 30]})
    run, out = tmp_path / "runs" / EVIL, tmp_path / "out"
    shutil.copytree(SHIPPED / "crater-detector", run)
    # Values of few images stand beside their names.
    for count in (len(images), 2):
        coco = {"categories": categories, "images": images[:count], "annotations": annotations[:count]}
        (folder / "annotations.json").write_text(json.dumps(coco))
        command = ["detect", "evaluate", "--run", run, "--images", folder, "--out", out / str(count)]
        ended = accepted(f"{count} labelled images", train, *command)
        check_printed(ended)
        compared = accepted(f"compare {count}", train, "detect", "compare", out / str(count), "--out", out / "compared")
        check_printed(compared)
        check_pages(out)


@pytest.mark.parametrize("name", NAMES)
def test_places_that_do_not_exist(tmp_path: Path, name: str) -> None:
    """A path in an error message of each program."""
    place = tmp_path / NAMES[name]
    for program, command in (
        (manifest, ["stats", place]),
        (manifest, ["validate", place]),
        (train, ["detect", "predict", f"{place}.png", "--out", tmp_path / "out"]),
        (train, ["report", "--dataset", place, "--out", tmp_path / "out"]),
        (render, ["dataset", "--manifest", place, "--out", tmp_path / "out"]),
        (render, ["config", "--config", place]),
    ):
        ended = outcome(f"{command[0]}: {name}", program, *command)
        check_printed(ended)
        assert ended.code == 2, (command, ended.output[-2000:])


@pytest.mark.parametrize("name", NAMES)
def test_names_of_datasets(tmp_path: Path, name: str) -> None:
    """A dataset with such a name, history or licence is refused; its folder may have any name."""
    folder = tmp_path / NAMES[name]
    build_dataset(folder, "detect", splits={"train": 1}, n_frames=1, side_px=32, craters=20)
    for command in ("validate", "stats", "card"):
        ended = accepted(f"{command}: {name}", manifest, command, folder)
        check_printed(ended)
    text = NAMES[name]
    if name == "long":
        text *= 10
    for field in ("name", "licence"):
        content = json.loads((folder / "dataset.json").read_text())
        content[field] = text
        other = tmp_path / "other" / field
        shutil.copytree(folder, other)
        (other / "dataset.json").write_text(json.dumps(content))
        if field == "licence" and not set(text) & set("<>&`$\x1b\n\u202e\ufffd") and len(text) <= 500:
            continue
        check_printed(refused(f"{field}: {name}", manifest, "stats", other, naming=field))


def test_paths_that_are_no_text(tmp_path: Path) -> None:
    """A path in another encoding than UTF-8 is refused before anything is written, and so is one in a folder."""
    place = f"{tmp_path}/\udcff\udcfe"
    out = tmp_path / "out"
    for program, command in (
        (manifest, ["stats", place]),
        (train, ["detect", "predict", f"{place}.png", "--out", out]),
        (train, ["detect", "compare", place, "--out", out]),
        (render, ["dataset", "--manifest", place, "--out", out]),
        (render, ["dataset", "--preset", "tiny", "--out", place]),
    ):
        check_printed(refused(f"bytes that are no text: {command[0]}", program, *command, naming="UTF-8"))
    (tmp_path / "images").mkdir()
    Path(f"{tmp_path}/images/\udcff.png").write_bytes(cv2.imencode(".png", np.zeros((64, 64), np.uint8))[1].tobytes())
    Path(f"{tmp_path}/images/\udcff.txt").write_text("X,Y,W,H\n10,10,30,30\n")
    command = ["detect", "evaluate", "--images", tmp_path / "images", "--out", out]
    check_printed(refused("image whose name is no text", train, *command, naming="UTF-8"))
    assert not out.exists() and not Path(place).exists()
