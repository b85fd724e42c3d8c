"""Evaluate a finished run on a split of any dataset."""

from pathlib import Path
from typing import Literal

from perilune_shared.dataset.manifest import open_single
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import load_split
from perilune_train.detect.evaluate.matching import EDGE
from perilune_train.detect.evaluate.report import write_evaluation
from perilune_train.detect.evaluate.split_evaluation import (
    WRITTEN,
    dataset_entries,
    evaluate_split,
    report_head,
    selection_entries,
    write_detections,
)
from perilune_train.detect.finished_run import check_output, chosen_threshold
from perilune_train.detect.inference.detector import open_detector
from perilune_train.detect.inference.scales import detect_split
from perilune_train.detect.train.threshold import threshold_on_validation
from perilune_train.records.marks import mark_files
from perilune_train.records.metrics_file import read_metrics, write_metrics
from perilune_train.records.provenance import (
    EvaluatedSplit,
    Provenance,
    check_terrain,
    protocol_of,
    read_provenance,
    split_terrain,
)
from perilune_train.training import runs


def evaluate_again(
    run: Path,
    config: DetectConfig,
    evaluated: EvaluatedSplit,
    threshold: float | Literal["run", "validation"] = "run",
    out: Path | None = None,
) -> Path:
    """Evaluate a run's best weights on a split of a dataset; all output is in the returned folder.

    `threshold` is a score; "run" takes the threshold that the run chose, and "validation" chooses a new one on the
    validation split of the dataset. Without `out`, the folder is `evaluation` in the run's folder.
    """
    folder = out or run / "evaluation"
    check_output(folder, run)
    choose_threshold, split = threshold == "validation", evaluated.split
    if isinstance(threshold, str):
        chosen, threshold_source = chosen_threshold(run), "of the run, chosen on its validation split"
    else:
        chosen, threshold_source = threshold, "given on the command line"
    known = read_metrics(run).get("dataset/name")
    dataset = open_single(evaluated.dataset)
    best = runs.RunFolder(run).best
    terrain = read_provenance(runs.load_weights(best), best)
    if choose_threshold:
        terrain = Provenance(split_terrain(dataset, "val", "calibrated")).joined([terrain])
    terrain_check = check_terrain(terrain, dataset, split, evaluated.allow_overlap)
    protocol = protocol_of(dataset.info)
    if known is not None and known != dataset.info.name:
        protocol = f"not the run's dataset ({known}); split by {dataset.info.split_by}"
    if split != "test":
        protocol += f"; {split} frames, used to {'train' if split == 'train' else 'select'} the network"
    detector = open_detector(best, config)
    frames = load_split(dataset, split, config.labels, (1.0, 1 / EDGE))
    if choose_threshold:
        val = load_split(dataset, "val", config.labels)
        seen, _ = detect_split(detector, val, "val")
        chosen, chosen_on = threshold_on_validation(detector, val, seen)
        threshold_source = f"{chosen_on} of the dataset"
    found, rate = detect_split(detector, frames, split)
    evaluation = evaluate_split(frames, found, config, chosen)
    write_detections(folder / "detections.parquet", frames, found)
    about = report_head(dataset, split, config, protocol, run.resolve().name, threshold_source)
    write_evaluation(folder, evaluation, list(frames.frames.images), about)
    metrics = (
        selection_entries(config, frames) | dataset_entries(dataset, split, config) | {"dataset/protocol": protocol}
    )
    metrics |= {f"{split}/{key}": value for key, value in evaluation.figures().items()}
    metrics[f"{split}/images_per_s"] = round(rate, 2)
    mark_files(folder, WRITTEN, terrain_check.mark)
    write_metrics(folder, metrics | terrain_check.metrics())
    return folder
