"""The networks that are installed: listed, used without --run, and refused in one line if there is none."""

import hashlib
import json
import shutil
import zlib
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process
from tests.helpers.stored_run import THRESHOLD, store_run

from perilune_shared.dataset.manifest import open_dataset
from perilune_train.cli.main import main
from perilune_train.shipped import models
from perilune_train.training.half_weights import write_half
from perilune_train.training.runs import RunFolder, load_weights

ROOT = Path(__file__).parents[2]


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 256, (96, 96), np.uint8))
    return path


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """A folder with one installed detector, as scripts/ship.py writes it."""
    run, folder = store_run(tmp_path / "run"), tmp_path / "shipped" / "crater-detector"
    folder.mkdir(parents=True)
    write_half(folder / "weights.safetensors", load_weights(RunFolder(run).best))
    for name in ("config.yaml", "metrics.json"):
        shutil.copyfile(run / name, folder / name)
    figures = {"headline/ap50_paper": 0.5, "headline/ap50_paper_account": "paper, strict"}
    (folder / "benchmark.json").write_text(json.dumps(figures))
    monkeypatch.setattr(models, "_FOLDER", folder.parent)
    return folder


def test_they_are_listed(shipped):
    done = in_process.call(main, "models")
    assert done.returncode == 0
    (line,) = done.stdout.splitlines()
    assert line.startswith("crater-detector  detect  ") and line.endswith(str(shipped))
    assert "AP 0.500 (paper, strict)" in line
    (shipped / "benchmark.json").unlink()
    assert "not scored on the locked benchmark" in in_process.call(main, "models").stdout


def test_predict_needs_no_run(shipped, picture, tmp_path):
    done = in_process.call(main, "detect", "predict", picture, "--out", tmp_path / "a")
    assert done.returncode == 0, done.stderr
    named = in_process.call(main, "detect", "predict", picture, "--out", tmp_path / "b", "--run", shipped)
    assert named.returncode == 0
    found, again = (pd.read_parquet(tmp_path / name / "detections.parquet") for name in "ab")
    assert found.equals(again) and (found["score"] >= THRESHOLD).all()


def test_evaluation_needs_no_run(shipped, picture, tmp_path):
    picture.with_suffix(".txt").write_text("X,Y,W,H\n10,10,20,20\n50,40,30,30\n")
    out = ("--out", tmp_path / "report")
    done = in_process.call(main, "detect", "evaluate", "--images", picture.parent, *out)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report" / "report.md").is_file() and not list(shipped.glob("images"))
    for given, missing in ((("--images", picture.parent), "--out"), (out, "--dataset")):
        refused = in_process.call(main, "detect", "evaluate", *given)
        assert refused.returncode == 2 and refused.stderr.startswith(f"error: {missing}: ")


@pytest.mark.parametrize("model", models.shipped_models(), ids=lambda model: model.name)
def test_the_installed_network_is_the_one_on_its_card(model):
    """Size, training data and figures; the same card is in the docs."""
    assert model.megabytes <= 8
    card = (model.folder / models.CARD).read_text(encoding="utf-8")
    assert card == (ROOT / f"docs/reference/models/{model.name}.md").read_text(encoding="utf-8")
    content = load_weights(RunFolder(model.folder).best)
    names = ["shipped-detect", *(["oblique-detect"] if content["architecture"].get("ellipses") else [])]
    manifests = [ROOT / "data_manifests" / each / "dataset.json" for each in names]
    assert all(hashlib.sha256(manifest.read_bytes()).hexdigest()[:16] in card for manifest in manifests)
    figures = json.loads((model.folder / models.BENCHMARK).read_text(encoding="utf-8"))
    assert f"{figures['headline/ap50_paper']:.3f}" in card
    tables = [open_dataset(manifest.parent).table("scenes", ["content_sha256"]) for manifest in manifests]
    scenes = {each for table in tables for each in table["content_sha256"].to_pylist()}
    record = content["terrain"]
    assert record["known"] and {use[3] for use in record["uses"]} <= scenes


def test_their_weights_take_eight_mebibytes_of_a_clone():
    """Git and wheels compress files; so is measured here."""
    weights = [(model.folder / models.WEIGHTS).read_bytes() for model in models.shipped_models()]
    assert len(weights) == 1 and sum(len(zlib.compress(content)) for content in weights) <= 8 * 2**20


def test_without_an_installed_network_a_run_is_needed(picture, tmp_path, monkeypatch):
    monkeypatch.setattr(models, "_FOLDER", tmp_path)
    for command in [("detect", *command) for command in (("predict", picture), ("benchmark",), ("deploy",))]:
        done = in_process.call(main, *command, "--out", tmp_path / "out")
        assert done.returncode == 2 and "no network is installed" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "out").exists()
    assert in_process.call(main, "models").stdout == ""
