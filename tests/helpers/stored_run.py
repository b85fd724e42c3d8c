"""Detect runs without training: random weights, a configuration and a threshold."""

from pathlib import Path

import numpy as np

from perilune_shared.config.resolve import resolve
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.finished_run import config_of_run
from perilune_train.detect.train.detect_run import build_network
from perilune_train.records.metrics_file import write_metrics
from perilune_train.training import runs
from perilune_train.training.begin import start_run

THRESHOLD = 0.005


def store_run(root: Path, *more: str) -> Path:
    """Store a run below `root`, with `more` settings; its network has detections everywhere, with scores near 0.01."""
    settings = ("width=0.125", "precision=float32", "device=cpu", "evaluation.min_score=0.001", *more)
    config = resolve(DetectConfig, "detect", "perilune_train", "tiny", None, tuple(f"detect.{s}" for s in settings))
    run = runs.RunFolder(root / "detect" / "stored")
    start_run(run, "detect", config, {}, "new")
    network = build_network(config, np.random.default_rng(0).uniform(4, 40, (500, 2)), root)
    names = ("in_channels", "width", "attention", "strides", "ellipses")
    runs.save_weights(run.best, config.model_dump(mode="json", include=set(names)), network)
    write_metrics(run.root, {"test/threshold": THRESHOLD})
    return run.root


def settings_of(run: Path, *settings: str) -> DetectConfig:
    """Return the stored settings of a run, with some of them changed."""
    return config_of_run(run, settings)
