"""Settings, threshold and calibration of a finished detect run, read from its folder."""

import math
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from perilune_shared.config.resolve import parse_setting, read_config_file, resolve_over
from perilune_shared.errors import UserError
from perilune_train.detect.config import DetectConfig
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics

if TYPE_CHECKING:
    # Commands read settings before they load NumPy.
    from perilune_train.detect.calibration import Calibration

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
    """Score threshold that a run chose on its validation split, for the detections of `open_run`.

    It is a probability if the run has a calibration. Raises UserError if it is missing.
    """
    calibrated = calibration_of(run) is not None
    return _number(run, "calibration/threshold" if calibrated else "test/threshold", "a number; or give --threshold")


def raw_threshold(run: Path) -> float:
    """The threshold of `chosen_threshold` for the network's scores before calibration."""
    calibrated = calibration_of(run) is not None
    return _number(run, "calibration/raw_threshold" if calibrated else "test/threshold", "a number")


def threshold_of_table(run: Path) -> float:
    """Score threshold for the table detections.parquet that is stored in a run or in an evaluation of its test split.

    It differs from `chosen_threshold` if the run was calibrated after the table had been written.
    """
    return _number(run, "test/threshold", "a number")


def calibration_of(run: Path) -> "Calibration | None":
    """Calibration of a run's scores; None if the run has none. Raises UserError if it is damaged."""
    return calibration_in(read_metrics(run), run / METRICS_FILE)


def calibration_in(metrics: Metrics, path: Path) -> "Calibration | None":
    """Calibration in the content of the file metrics.json at `path`; see `calibration_of`."""
    from perilune_train.detect.calibration import Calibration

    keys = [f"calibration/{part.name}" for part in fields(Calibration)]
    if not metrics.keys() & set(keys):
        return None
    a, b, c = (_finite(metrics, key, path, "a number") for key in keys)
    if min(a, b) < 0 or max(a, b) == 0:
        raise UserError(path, f"{keys[0]}, {keys[1]}", f"{a:g}, {b:g}", "0 or more, not both 0")
    return Calibration(a, b, c)


def _number(run: Path, key: str, expected: str) -> float:
    return _finite(read_metrics(run), key, run / METRICS_FILE, expected)


def _finite(metrics: Metrics, key: str, path: Path, expected: str) -> float:
    value = metrics.get(key)
    if isinstance(value, bool) or not isinstance(value, float | int) or not math.isfinite(value):
        raise UserError(path, key, value, expected)
    return float(value)


def check_output(folder: Path, run: Path) -> None:
    """Raise UserError if an evaluation would overwrite the run's own report and metrics."""
    if folder.resolve() == run.resolve():
        raise UserError(
            folder, "--out", "the run's own folder", "another folder; a run keeps the metrics of its training"
        )
