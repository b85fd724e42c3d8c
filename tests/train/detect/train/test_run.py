"""A whole detection run, and what wrong input gets."""

import json
import shutil

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from tests.train.detect.conftest import QUICK

from perilune_shared.config.resolve import resolve
from perilune_shared.config.yaml_text import parse_yaml
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.editing.pack import pack
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.ellipses import correlations_of, ellipses_of
from perilune_train.detect.evaluate.split_evaluation import ELLIPSE_COLUMNS
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.inference.detector import load_detector
from perilune_train.detect.train.detect_run import build_network, run_detect
from perilune_train.detect.train.loss import detection_loss
from perilune_train.detect.train.task import DetectTask
from perilune_train.detect.train.transfer import start_from
from perilune_train.training import runs


def settings(*more):
    return resolve(DetectConfig, "detect", "perilune_train", "tiny", None, (*QUICK, *more))


def test_a_run_leaves_all_its_files(finished):
    for name in (
        "config.yaml",
        "metrics.json",
        "detections.parquet",
        "detections.png",
        "precision_recall.png",
        "precision_recall.parquet",
        "bins.png",
        "report.md",
        "checkpoints/best.ckpt",
        "checkpoints/last.ckpt",
    ):
        assert finished.root.joinpath(name).stat().st_size > 0, name
    assert list(finished.root.glob("events.out.tfevents*"))
    assert not list(finished.root.rglob(".*part*"))
    metrics = json.loads(finished.metrics.read_text())
    for scoring_rule in ("test/", "test/strict/", "val/"):
        assert 0 <= metrics[scoring_rule + "ap50_paper"] <= 1
    assert metrics["test/strict/precision"] <= metrics["test/precision"]
    assert metrics["test/frames"] == 8
    assert metrics["train/epochs"] == 2
    assert 0 < metrics["anchors/mean_best_iou"] <= 1 and 0 < metrics["anchors/best_possible_recall"] <= 1
    assert parse_yaml(finished.config.read_text(), "")["detect"]["strides"] == [4, 8, 16]


def test_a_run_predicts_ellipses_with_deviations(finished):
    assert runs.load_weights(finished.best)["architecture"]["ellipses"] is True
    table = pd.read_parquet(finished.root / "detections.parquet")
    assert len(table) > 100
    boxes = table[["x0_px", "y0_px", "x1_px", "y1_px"]].to_numpy()
    ellipses = np.column_stack(
        [
            (boxes[:, :2] + boxes[:, 2:]) / 2,
            table["semi_major_px"],
            table["semi_minor_px"],
            np.radians(table["angle_deg"]),
        ]
    )
    np.testing.assert_allclose(ellipses_of(boxes, correlations_of(ellipses)), ellipses, atol=1e-6)
    assert (correlations_of(ellipses) != 0).mean() > 0.9 and (table[list(ELLIPSE_COLUMNS[3:])] > 0).all(axis=None)
    metrics = json.loads(finished.metrics.read_text())
    assert 0 <= metrics["test/strict/ellipse_score"] <= 100 and 0 <= metrics["test/ellipse_score"] <= 100
    for name in ("centre_error_px_rms", "semi_major_error_px_median", "axes_normalised_error_squared"):
        assert f"test/{name}" in metrics
    assert "## Ellipses of detected craters" in finished.root.joinpath("report.md").read_text()


def test_a_run_stores_the_selection_that_it_used(finished):
    visible = {
        "selection": "visible",
        "min_visible_fraction": 0.3,
        "min_sunlit_fraction": 0.1,
        "min_depth_ratio": 0.04,
        "min_contrast": 5.0,
        "contrast_pixels": 250.0,
    }
    stored = parse_yaml(finished.config.read_text(), "")["detect"]["labels"]
    assert stored == {**visible, "radius_px": [2.0, None]}
    metrics = json.loads(finished.metrics.read_text())
    message = {key.removeprefix("labels/"): value for key, value in metrics.items() if key.startswith("labels/")}
    assert message == {**visible, "min_radius_px": 2.0, "max_radius_px": 50.0}
    # The stored file alone resolves to the same.
    assert config_of_run(finished.root).labels == settings().labels


def test_a_selection_is_named_and_its_thresholds_replaced():
    paper = settings("detect.labels.selection=paper", "detect.labels.radius_px=[3, 20]").labels
    assert (paper.selection, paper.radius_px, paper.min_contrast) == ("paper", (3.0, 20.0), None)
    bold = settings("detect.labels.min_contrast=10").labels
    assert (bold.selection, bold.min_contrast, bold.min_depth_ratio) == ("visible", 10.0, 0.04)
    assert settings("detect.labels.min_contrast=null").labels.min_contrast is None


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("selection=visibel", "detect.labels.selection: got 'visibel', expected visible (nearest known)"),
        ("selection=3", "detect.labels.selection: got 3, expected "),
        ("min_contrst=3", "min_contrst: got an unknown key, expected min_contrast (nearest known)"),
        ("radius_px=[3, 20, 30]", "detect.labels.radius_px: got"),
        ("min_depth_ratio=deep", "detect.labels.min_depth_ratio: got 'deep', expected "),
    ],
)
def test_an_unknown_selection_is_refused_in_one_line(setting, message):
    with pytest.raises(UserError) as caught:
        settings(f"detect.labels.{setting}")
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_the_table_of_detections(finished, dataset_detect):
    table = pq.read_table(finished.root / "detections.parquet").to_pandas()
    assert list(table.columns) == ["frame_id", "x0_px", "y0_px", "x1_px", "y1_px", "score", *ELLIPSE_COLUMNS]
    assert set(table["frame_id"]) <= {f"s004/t004/{k:06d}" for k in range(8)}
    assert (table["x1_px"] > table["x0_px"]).all()
    assert table["score"].between(0.01, 1).all()


@pytest.mark.usefixtures("no_pictures")
def test_the_same_seed_gives_the_same_weights_also_when_resumed(finished, dataset_detect, tmp_path, monkeypatch):
    original = DetectTask.training_step

    def dies(self, batch, batch_idx):
        if self.current_epoch == 1 and batch_idx == 1:
            raise KeyError("killed")
        return original(self, batch, batch_idx)

    monkeypatch.setattr(DetectTask, "training_step", dies)
    with pytest.raises(KeyError):
        run_detect(settings(), dataset_detect, tmp_path, "b")
    monkeypatch.undo()
    run = run_detect(settings(), dataset_detect, tmp_path, "b")
    first, again = (torch.load(r.last, weights_only=True)["state_dict"] for r in (finished, run))
    assert first.keys() == again.keys()
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert [torch.load(r.last, weights_only=True)["images_seen"] for r in (finished, run)] == [48, 48]
    timed = ("train/seconds", "train/images_per_s", "test/images_per_s")
    metrics = [{k: v for k, v in json.loads(r.metrics.read_text()).items() if k not in timed} for r in (finished, run)]
    assert metrics[0] == metrics[1]


def test_a_finished_run_is_left_as_it_is(finished, few, tmp_path, capsys):
    def files():
        return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in finished.root.rglob("*")}

    before = files()
    run_detect(settings("detect.workers=1"), tmp_path / "absent", finished.root.parents[1], "a")
    assert "finished, left unchanged; --overwrite replaces it" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(UserError, match=r"config.yaml: detect.learning_rate: got 0.01, expected 0.005, .*--overwrite"):
        other = settings("detect.learning_rate=0.01")
        run_detect(other, tmp_path / "absent", finished.root.parents[1], "a")
    with pytest.raises(UserError, match=r"inputs.json: dataset: got SHA-256 .*as in the existing run; --overwrite"):
        run_detect(settings(), few, finished.root.parents[1], "a")
    assert files() == before


@pytest.fixture
def no_evaluation(monkeypatch):
    """Train without evaluation, which takes most of the time of a small run."""
    monkeypatch.setattr("perilune_train.detect.train.detect_run.evaluate", lambda *_: {})


@pytest.mark.slow
def test_resuming_does_not_need_the_initial_weights(finished, few, tmp_path, no_evaluation):
    """The last state of a run that was stopped while it was evaluated: all trained, no figures yet."""
    first = tmp_path / "first.ckpt"
    shutil.copy(finished.best, first)
    config = settings("detect.epochs=1", f"detect.init_from={first}")
    run = run_detect(config, few, tmp_path, "a")
    last, callbacks = run.last.read_bytes(), torch.load(run.last, weights_only=True)["callbacks"]
    seconds = next(kept["seconds"] for kept in callbacks.values() if "seconds" in kept)
    first.unlink()
    run.metrics.unlink()
    run_detect(config, few, tmp_path, "a")
    assert run.last.read_bytes() == last
    metrics = json.loads(run.metrics.read_text())
    assert metrics["train/seconds"] >= round(seconds, 1)
    assert metrics["train/images_per_s"] > 0


def test_the_anchors_are_told_before_training(few, tmp_path, monkeypatch, capsys):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("perilune_train.detect.train.detect_run.fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_detect(settings(), few, tmp_path, "a")
    assert "anchors: best possible recall" in capsys.readouterr().err


def test_the_report_tells_of_the_anchors(finished):
    best = json.loads(finished.metrics.read_text())["anchors/best_possible_recall"]
    assert f"- anchors: best possible recall {best:.4f}," in (finished.root / "report.md").read_text()


@pytest.mark.usefixtures("no_pictures")
def test_a_run_in_bfloat16(few, tmp_path, monkeypatch):
    coarse = []

    def recorded(outputs, *more):
        coarse.extend(torch.equal(part, part.bfloat16().float()) for part in outputs)
        return detection_loss(outputs, *more)

    monkeypatch.setattr("perilune_train.detect.train.task.detection_loss", recorded)
    run = run_detect(settings("detect.epochs=1", "detect.precision=bf16"), few, tmp_path, "a")
    assert coarse and all(coarse)
    weights = runs.load_weights(run.best)["state_dict"].values()
    assert {value.dtype for value in weights if value.is_floating_point()} == {torch.float32}
    assert all(value.isfinite().all() for value in weights)
    metrics = json.loads(run.metrics.read_text())
    for scoring_rule in ("test/", "test/strict/", "test/edge/", "val/"):
        assert 0 <= metrics[scoring_rule + "ap50_paper"] <= 1


@pytest.mark.slow
def test_a_packed_dataset_gives_the_same_weights(few, tmp_path, no_evaluation):
    pack(open_dataset(few), tmp_path / "packed")
    config = settings("detect.epochs=1")
    made = [run_detect(config, root, tmp_path, root.name) for root in (few, tmp_path / "packed")]
    first, again = (runs.load_weights(run.best)["state_dict"] for run in made)
    assert first.keys() == again.keys() and all(torch.equal(first[key], again[key]) for key in first)


def test_fewer_frames_than_processes(few, tmp_path):
    with pytest.raises(UserError, match=r"/few: val frames: got 2, expected at least 3, one for each process"):
        run_detect(settings("detect.devices=3"), few, tmp_path / "runs", "a")
    assert not (tmp_path / "runs").exists()


def test_a_detector_comes_back_as_it_was_saved(finished):
    network = load_detector(finished.best)
    saved = runs.load_weights(finished.best)["state_dict"]
    assert network.strides == (4, 8, 16)
    assert torch.equal(network.anchors, saved["anchors"])
    assert not network.training


@pytest.mark.parametrize(
    "changes, stays",
    [
        ([], ()),
        (["detect.attention=cbam"], ("backbone.attentions.",)),
        (["detect.attention=none"], ()),
        (["detect.strides=[8,16,32]"], ("branches.", "heads.", "ellipse_tower.", "laterals.", "anchors")),
    ],
)
def test_a_run_starts_from_what_an_earlier_one_has_for_it(finished, tmp_path, changes, stays):
    config = settings(*changes)
    network = build_network(config, torch.rand(50, 2).numpy() + 4, tmp_path)
    before = {key: value.clone() for key, value in network.state_dict().items()}
    start_from(network, finished.best, config)
    saved = runs.load_weights(finished.best)["state_dict"]
    for key, value in network.state_dict().items():
        assert torch.equal(value, before[key] if key.startswith(stays) else saved[key]), key


def test_a_run_of_another_width_is_refused(finished, tmp_path):
    config = settings("detect.width=0.25")
    network = build_network(config, torch.rand(50, 2).numpy() + 4, tmp_path)
    with pytest.raises(UserError, match=r"best.ckpt: width: got 0.125, expected 0.25"):
        start_from(network, finished.best, config)


def test_another_kind_of_checkpoint(tmp_path):
    path = tmp_path / "best.ckpt"
    runs.save_weights(path, {"hidden": 3}, torch.nn.Linear(2, 2))
    with pytest.raises(UserError, match="a detect run's checkpoint"):
        load_detector(path)


def test_nothing_is_written_for_a_missing_dataset_or_checkpoint(dataset_detect, tmp_path):
    with pytest.raises(UserError, match=r"dataset.json: got no such file"):
        run_detect(settings(), tmp_path / "absent", tmp_path / "runs", "a")
    with pytest.raises(UserError, match="no such file"):
        run_detect(settings("detect.init_from=absent.ckpt"), dataset_detect, tmp_path / "runs", "a")
    assert not (tmp_path / "runs").exists()


def test_a_dataset_without_craters_to_find(tmp_path, make_dataset):
    root = make_dataset(tmp_path / "d", "detect", n_frames=1, craters=20)
    with pytest.raises(UserError, match="no visible crater in the training split"):
        run_detect(settings("detect.labels.min_depth_ratio=0.9"), root, tmp_path / "runs", "a")
