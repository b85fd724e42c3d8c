"""Training fits a calibration at its end, and `detect calibrate` adds one to an older run."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from tests.helpers import in_process

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_train.cli.main import main
from perilune_train.detect.data.split import load_split
from perilune_train.detect.finished_run import (
    calibration_of,
    chosen_threshold,
    config_of_run,
    raw_threshold,
    threshold_of_table,
)
from perilune_train.detect.images.find import load_detector
from perilune_train.detect.inference.detector import load_detector as load_network
from perilune_train.detect.inference.detector import open_detector, open_run
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.detect.novelty import fit_training_features, write_training_features
from perilune_train.detect.train.threshold import calibration_entries, detect_validation
from perilune_train.landing.fly.detections import by_network
from perilune_train.records.metrics_file import read_metrics
from perilune_train.shipped.models import shipped_run
from perilune_train.training import runs

THRESHOLD = 0.5


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    """The installed detector as a run without calibration, and without a record of its terrain."""
    run = runs.RunFolder(tmp_path_factory.mktemp("old"))
    network = load_network(shipped_run("detect") / "weights.safetensors")
    architecture = runs.load_weights(shipped_run("detect") / "weights.safetensors")["architecture"]
    runs.save_weights(run.best, architecture, network)
    shutil.copyfile(shipped_run("detect") / "config.yaml", run.config)
    run.metrics.write_text(json.dumps({"test/threshold": THRESHOLD, "test/ap50_paper": 0.8}))
    return run.root


@pytest.fixture(scope="module")
def split(dataset_detect, old):
    return load_split(open_dataset(dataset_detect), "val", config_of_run(old).labels)


@pytest.fixture(scope="module")
def calibrated(old, dataset_detect, tmp_path_factory):
    """A calibrated copy of the old run, and what the command printed."""
    run = tmp_path_factory.mktemp("calibrated") / "run"
    shutil.copytree(old, run)
    done = in_process.call(main, "detect", "calibrate", "--run", run, "--dataset", dataset_detect)
    assert done.returncode == 0, done.stderr
    return run, done.stderr + done.stdout


def test_the_command_adds_a_calibration_and_keeps_all_other_metrics(old, calibrated):
    run, printed = calibrated
    metrics = read_metrics(run)
    assert {key: metrics[key] for key in read_metrics(old)} == read_metrics(old)
    assert metrics["calibration/frames"] == "val and varied val" and metrics["calibration/detections"] > 100
    assert metrics["calibration/ece_after"] < metrics["calibration/ece_before"]
    assert f"{metrics['calibration/ece_after']:.3f} after" in printed
    assert raw_threshold(run) == threshold_of_table(run) == THRESHOLD
    assert chosen_threshold(run) == calibration_of(run).probability(THRESHOLD) != THRESHOLD
    assert chosen_threshold(old) == raw_threshold(old) == THRESHOLD and calibration_of(old) is None


def test_detections_stay_and_their_scores_are_probabilities(old, calibrated, split):
    run, _ = calibrated
    frames = split.frames.images
    plain = detect_at_scales(open_run(old, config_of_run(old)), frames)
    mapped = detect_at_scales(open_run(run, config_of_run(run)), frames)
    for before, after in zip(plain, mapped, strict=True):
        assert np.array_equal(before.boxes, after.boxes)
        assert np.array_equal(calibration_of(run).probabilities(before.scores), after.scores)
        assert np.array_equal(before.scores >= chosen_threshold(old), after.scores >= chosen_threshold(run))
    error = detect_validation(open_run(run, config_of_run(run)), split, mapped).decided_matches(
        config_of_run(run).evaluation
    )
    assert abs(error.scores.mean() - error.matched.mean()) < 0.02


def test_a_second_calibration_replaces_the_first(calibrated, dataset_detect, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(calibrated[0], run)
    metrics = read_metrics(run)
    (run / "metrics.json").write_text(json.dumps(metrics | {"calibration/offset": 3.0, "calibration/old": 1}))
    assert in_process.call(main, "detect", "calibrate", "--run", run, "--dataset", dataset_detect).returncode == 0
    assert read_metrics(run) == metrics


def test_predict_says_whether_there_is_an_alarm(old, split, tmp_path):
    """Without training features one line says so; with those of other frames, one warning."""
    Image.fromarray(split.frames.images[0]).save(tmp_path / "a.png")
    with_alarm = tmp_path / "run"
    shutil.copytree(old, with_alarm)
    noise = np.random.default_rng(0).integers(0, 256, (12, 128, 128)).astype(np.uint8)
    features = open_detector(runs.RunFolder(old).best, config_of_run(old)).features(noise)
    write_training_features(with_alarm, fit_training_features(features, np.arange(12) % 4))
    tables, notes = [], []
    for name, run in (("without", old), ("with", with_alarm)):
        out = tmp_path / name
        done = in_process.call(main, "detect", "predict", tmp_path / "a.png", "--run", run, "--out", out)
        assert done.returncode == 0, done.stderr
        tables.append(pd.read_parquet(out / "detections.parquet"))
        notes.append(done.stderr)
    assert tables[0]["novelty"].isna().all() and "no alarm for images unlike the training" in notes[0]
    assert (tables[1]["novelty"] > 1).all() and tables[1]["novelty"].nunique() == 1
    assert notes[1].count("warning: a.png: novelty: got ") == 1 and "no alarm" not in notes[1]
    craters = load_detector(with_alarm)(tmp_path / "a.png")
    assert craters.novelty == pytest.approx(tables[1]["novelty"][0])


def test_predict_says_whether_scores_are_probabilities(old, calibrated, split, tmp_path):
    """The tables have the same craters; only the scores differ."""
    Image.fromarray(split.frames.images[0]).save(tmp_path / "a.png")
    tables, notes = [], []
    for run in (old, calibrated[0]):
        out = tmp_path / run.name
        done = in_process.call(main, "detect", "predict", tmp_path / "a.png", "--run", run, "--out", out)
        assert done.returncode == 0
        tables.append(pd.read_parquet(out / "detections.parquet"))
        notes.append([line for line in done.stderr.splitlines() if "scores are no probabilities" in line])
    assert len(notes[0]) == 1 and not notes[1]
    same = [table.drop(columns=["score", "novelty"]) for table in tables]
    assert len(tables[0]) > 5 and same[0].equals(same[1])
    raw, probability = (table["score"].to_numpy() for table in tables)
    assert np.array_equal(calibration_of(calibrated[0]).probabilities(raw), probability)
    craters = load_detector(calibrated[0])(tmp_path / "a.png")
    assert craters["score"] == pytest.approx(probability)


def test_the_filter_has_the_scores_of_the_network(old, calibrated, split, tmp_path):
    """It derives the error of a centre from them."""
    Image.fromarray(split.frames.images[0]).save(tmp_path / "a.png")
    before, after = (by_network(run)(tmp_path / "a.png") for run in (old, calibrated[0]))
    assert len(before.scores) > 5 and np.array_equal(before.scores, after.scores)


def test_evaluations_report_the_error(calibrated, dataset_detect, tmp_path):
    done = in_process.call(
        main,
        "detect",
        "evaluate",
        "--run",
        calibrated[0],
        "--dataset",
        dataset_detect,
        "--split",
        "val",
        "--out",
        tmp_path,
    )
    assert done.returncode == 0, done.stderr
    metrics = read_metrics(tmp_path)
    assert metrics["val/threshold"] == chosen_threshold(calibrated[0])
    assert 0 < metrics["val/ece"] < 0.1 and 0 < metrics["val/strict/ece"] < 1
    report = (tmp_path / "report.md").read_text()
    assert "a score is the probability that the detection matches a label" in report
    assert "## Scores as probabilities" in report and (tmp_path / "reliability.png").stat().st_size > 10_000


def test_other_terrain_is_refused(dataset_detect, tmp_path):
    """The installed detector has a record of its terrain, which lacks these scenes."""
    run = tmp_path / "run"
    shutil.copytree(shipped_run("detect"), run)
    before = (run / "metrics.json").read_bytes()
    done = in_process.call(main, "detect", "calibrate", "--run", run, "--dataset", dataset_detect)
    assert done.returncode == 2 and "validation scenes of the run's own dataset" in done.stderr
    assert (run / "metrics.json").read_bytes() == before


def test_too_few_detections_change_nothing(finished, dataset_detect):
    """A network after two epochs finds almost nothing; training goes on without a calibration."""
    metrics = read_metrics(finished.root)
    assert metrics["calibration"] == "none: too few detections, or scores without information"
    assert calibration_of(finished.root) is None and np.isfinite(metrics["test/ece"])
    done = in_process.call(main, "detect", "calibrate", "--run", finished.root, "--dataset", dataset_detect)
    assert done.returncode == 2 and "too few detections" in done.stderr
    assert read_metrics(finished.root) == metrics


def test_entries_of_training_are_those_of_the_command(old, calibrated, split):
    """Training calls the same two functions with the threshold that it chose."""
    config = config_of_run(old)
    found = detect_validation(open_detector(runs.RunFolder(old).best, config), split)
    entries = calibration_entries(found, config.evaluation, THRESHOLD)
    assert entries == {key: value for key, value in read_metrics(calibrated[0]).items() if key in entries}
    threshold, chosen_on = found.threshold(config.evaluation)
    assert 0.2 < threshold < 0.9 and chosen_on.endswith("on val and varied val")


@pytest.mark.parametrize(
    "change", [{"calibration/offset": None}, {"calibration/log_score": -1.0}, {"calibration/threshold": "high"}]
)
def test_a_damaged_calibration_is_an_error(calibrated, tmp_path, change):
    (tmp_path / "metrics.json").write_text(json.dumps(read_metrics(calibrated[0]) | change))
    with pytest.raises(UserError, match=next(iter(change))):
        chosen_threshold(tmp_path)
