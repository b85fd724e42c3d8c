"""Fit, for a finished run, the calibration of its scores and the features of its training frames.

The calibration is fitted on validation frames and stored in metrics.json; the features are stored in novelty.json.
"""

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
from perilune_train.detect.novelty import write_training_features
from perilune_train.detect.train.threshold import calibration_entries, detect_validation
from perilune_train.detect.train.training_features import training_features
from perilune_train.records.metrics_file import METRICS_FILE, Metrics, read_metrics
from perilune_train.records.provenance import read_provenance, split_terrain
from perilune_train.training import runs


def calibrate_run(run: Path, config: DetectConfig, address: Address) -> Metrics:
    """Fit calibration and training features of a run on its dataset; return the new entries of metrics.json.

    Replaces earlier fits. The threshold moves with the scores, so the run reports the same detections as before. Other
    figures and tables of the run stay as they are. With too few training frames, an entry says that there is no alarm.
    Raises UserError, and changes nothing, if the run was not trained and selected on the terrain of these frames, or if
    there are too few detections.
    """
    threshold = raw_threshold(run)
    dataset = open_single(address)
    for split in ("val", "train"):
        _check_own_terrain(runs.RunFolder(run).best, dataset, split)
    detector = open_detector(runs.RunFolder(run).best, config)
    found = detect_validation(detector, load_split(dataset, "val", config.labels))
    entries = calibration_entries(found, config.evaluation, threshold)
    if "calibration/threshold" not in entries:
        raise UserError(dataset.store, "calibration", entries["calibration"], "a trained detector and more frames")
    kept = {
        key: value for key, value in read_metrics(run).items() if key.split("/")[0] not in ("calibration", "novelty")
    }
    # Each file is replaced at once; between them, an interrupted command leaves new features and the old calibration.
    entries |= write_training_features(run, training_features(detector, dataset))
    write_text(run / METRICS_FILE, json.dumps(kept | entries, indent=2, allow_nan=False) + "\n")
    return entries


def _check_own_terrain(checkpoint: Path, dataset: Dataset, split: str) -> None:
    """Raise UserError if the record in the checkpoint lacks the terrain of the frames of a split."""
    provenance = read_provenance(runs.load_weights(checkpoint), checkpoint)
    fitted = {use.sha256 for use in provenance.uses if use.use != "tested"}
    new = [use.scene_id for use in sorted(split_terrain(dataset, split, "calibrated")) if use.sha256 not in fitted]
    if provenance.known and new:
        kind = {"val": "validation", "train": "training"}[split]
        expected = f"{kind} scenes of the run's own dataset; its record of terrain has no others"
        raise UserError(dataset.store, f"{split} scenes", ", ".join(new[:4]), expected)
