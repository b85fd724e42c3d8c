"""Fit the calibration of a finished run's scores on validation frames, and store it in the run's metrics.json."""

import json
from pathlib import Path

from perilune_shared.dataset.manifest import Dataset, open_single
from perilune_shared.errors import UserError
from perilune_shared.storage.files import write_text
from perilune_shared.storage.store import Address
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import load_split
from perilune_train.detect.finished_run import raw_threshold
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.train.threshold import calibration_entries, detect_validation
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.records.provenance import read_provenance, split_terrain
from perilune_train.training import runs


def calibrate_run(run: Path, config: DetectConfig, address: Address) -> Metrics:
    """Fit the calibration of a run on the validation frames of its dataset; return its entries of metrics.json.

    Replaces an earlier calibration. The threshold moves with the scores, so the run reports the same detections as
    before. Other figures and tables of the run stay as they are. Raises UserError, and changes nothing, if the run was
    not selected on the terrain of these frames, or if there are too few detections.
    """
    threshold = raw_threshold(run)
    dataset = open_single(address)
    _check_own_terrain(runs.RunFolder(run).best, dataset)
    detector = open_detector(runs.RunFolder(run).best, config)
    found = detect_validation(detector, load_split(dataset, "val", config.labels))
    entries = calibration_entries(found, config.evaluation, threshold)
    if "calibration/threshold" not in entries:
        raise UserError(dataset.store, "calibration", entries["calibration"], "a trained detector and more frames")
    kept = {key: value for key, value in read_metrics(run).items() if key.split("/")[0] != "calibration"}
    # One file, replaced at once: an interrupted command leaves the run as it was.
    write_text(run / METRICS_FILE, json.dumps(kept | entries, indent=2, allow_nan=False) + "\n")
    return entries


def _check_own_terrain(checkpoint: Path, dataset: Dataset) -> None:
    """Raise UserError if the record in the checkpoint lacks the terrain of the validation frames."""
    provenance = read_provenance(runs.load_weights(checkpoint), checkpoint)
    fitted = {use.sha256 for use in provenance.uses if use.use != "tested"}
    new = [use.scene_id for use in sorted(split_terrain(dataset, "val", "calibrated")) if use.sha256 not in fitted]
    if provenance.known and new:
        expected = "validation scenes of the run's own dataset; its record of terrain has no others"
        raise UserError(dataset.store, "val scenes", ", ".join(new[:4]), expected)
