"""Settings and threshold of a finished detect run, read from its folder."""

import math
from pathlib import Path

from perilune_shared.config.resolve import parse_setting, read_config_file, resolve_over
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.records.metrics_file import METRICS_FILE, read_metrics

_MAY_CHANGE = ("evaluation", "labels", "device", "precision", "batch_size")


def config_of_run(run: Path, settings: tuple[str, ...] = ()) -> DetectConfig:
    """Settings of a run, read from its config.yaml.

    Settings missing from the file have their defaults. `settings` ("detect.evaluation.nms_iou=0.4") overrides single
    evaluation settings. Raises UserError if a setting would change the network.
    """
    path = run / "config.yaml"
    if not path.is_file():
        got = "a folder without config.yaml" if run.is_dir() else "no such folder"
        raise UserError(run, "run", got, "a detect run; train one: perilune-train detect train --preset small")
    section = read_config_file(path).get("detect")
    if section is None:
        raise UserError(path, "detect", "no such section", "config.yaml of a detect run")
    for text in settings:
        keys, _ = parse_setting(text)
        if keys[0] != "detect" or keys[1] not in _MAY_CHANGE:
            raise UserError(
                "--set", ".".join(keys), "not a setting of the evaluation", "detect.evaluation... or detect.labels..."
            )
    named = any(text.startswith("detect.labels.selection=") for text in settings)
    if named:
        # Drop the thresholds stored for the run's selection, so that the new selection sets its thresholds.
        section = {key: value for key, value in section.items() if key != "labels"}
    return resolve_over(DetectConfig, "detect", str(path), section, None, settings)


def chosen_threshold(run: Path) -> float:
    """Score threshold that a run chose on its validation split. Raises UserError if it is missing."""
    threshold = read_metrics(run).get("test/threshold")
    if isinstance(threshold, bool) or not isinstance(threshold, float | int) or not math.isfinite(threshold):
        raise UserError(run / METRICS_FILE, "test/threshold", threshold, "a number; or give --threshold")
    return float(threshold)


def check_output(folder: Path, run: Path) -> None:
    """Raise UserError if an evaluation would overwrite the run's own report and metrics."""
    if folder.resolve() == run.resolve():
        raise UserError(
            folder, "--out", "the run's own folder", "another folder; a run keeps the metrics of its training"
        )
