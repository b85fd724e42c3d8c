"""Evaluation of a split's detections: matches, metrics and output files."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.export.foreign_text import code_span, for_markdown
from perilune_shared.storage.files import written_aside
from perilune_train.detect.calibration import Calibration
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.evaluation import Evaluation, evaluate_detections
from perilune_train.detect.evaluate.matching import Criteria, Detections, Matches, joined_detections, match_split
from perilune_train.detect.novelty import is_novel
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.provenance import protocol_of

WRITTEN = (
    "report.md",
    "detections.png",
    "precision_recall.png",
    "reliability.png",
    "bins.png",
    "detections.parquet",
    "precision_recall.parquet",
)
"""Files that an evaluation writes in addition to metrics.json."""


ELLIPSE_COLUMNS = (
    "semi_major_px",
    "semi_minor_px",
    "angle_deg",
    "sigma_x_px",
    "sigma_y_px",
    "sigma_semi_major_px",
    "sigma_semi_minor_px",
)
"""Columns of a table of detections: the ellipse and its standard deviations."""


def ellipse_columns(detections: Detections) -> dict[str, NDArray[np.float64]]:
    """Values (D,) of ELLIPSE_COLUMNS.

    If the detector predicts no ellipses, these are the axis-aligned ellipses in the boxes, and the standard deviations
    are NaN.
    """
    _, _, major, minor, theta = detections.ellipses.T
    unknown = np.full((len(detections.scores), 4), np.nan)
    sigmas_px = unknown if detections.shapes is None else detections.shapes[:, 1:]
    return dict(zip(ELLIPSE_COLUMNS, [major, minor, np.degrees(theta), *sigmas_px.T], strict=True))


def match_detections(split: DetectSplit, detections: list[Detections], config: DetectConfig) -> Matches:
    """Match the detections of a split to its labels."""
    height, width = split.frames.images.shape[1:]
    return match_split(detections, split.labels, (width, height), config.evaluation.match_iou, split.radius_px)


def evaluate_split(
    split: DetectSplit, detections: list[Detections], config: DetectConfig, threshold: float
) -> Evaluation:
    """Compute all metrics of a split's detections."""
    criteria = Criteria(threshold, split.radius_px, config.evaluation.match_iou)
    return evaluate_detections(detections, split.labels, facts_of(split.frames), criteria, config.seed)


def selection_entries(config: DetectConfig, split: DetectSplit) -> Metrics:
    """The label selection for metrics.json: name and thresholds; null sets no threshold."""
    used = {f"labels/{key}": value for key, value in config.labels.model_dump(exclude={"radius_px"}).items()}
    return used | {"labels/min_radius_px": split.radius_px[0], "labels/max_radius_px": split.radius_px[1]}


def dataset_entries(dataset: Dataset, split: str, config: DetectConfig) -> Metrics:
    """Dataset, split and settings of an evaluation, for metrics.json."""
    return {
        "dataset/name": dataset.info.name,
        "dataset/split_by": dataset.info.split_by,
        "dataset/protocol": protocol_of(dataset.info),
        "evaluation/split": split,
        "evaluation/scales": " ".join(f"{factor:g}" for factor in config.evaluation.scales),
    }


def novel_entries(detections: list[Detections], prefix: str) -> Metrics:
    """Share of the frames that are unlike the training (novelty.py), for metrics.json; {} if unknown."""
    known = [of_frame.novelty for of_frame in detections if of_frame.novelty is not None]
    return {f"{prefix}novel_share": sum(map(is_novel, known)) / len(known)} if known else {}


def report_head(
    dataset: Dataset, split: str, config: DetectConfig, protocol: str, run: str, threshold_source: str
) -> list[str]:
    """Dataset, split and settings of an evaluation, for the head of a report."""
    settings = config.evaluation
    thresholds = config.labels.model_dump(exclude={"selection"}, exclude_none=True)
    return [
        f"run {code_span(run)}, best weights; dataset {code_span(dataset.info.name)}, "
        f"split {for_markdown(split)}; protocol: {protocol}",
        f"labels: selection `{config.labels.selection}` ({', '.join(f'{k} {v}' for k, v in thresholds.items())})",
        f"threshold {threshold_source}",
        f"detections below a score of {settings.min_score:g} (before calibration) are dropped, non-maximum suppression "
        f"at IoU {settings.nms_iou:g}, at most {settings.max_detections} detections per frame; frames evaluated "
        f"{at_scales(settings.scales)}",
    ]


def score_meaning(calibration: Calibration | None) -> str:
    """What a score is, for the head of a report."""
    if calibration is None:
        return "scores are those of the network, without calibration: a score is no probability"
    return (
        "scores are calibrated: a score is the probability that the detection matches a label, fitted on validation "
        "frames"
    )


def at_scales(scales: tuple[float, ...]) -> str:
    """Scales in words, for a report."""
    return "at scale " + " and ".join(f"{factor:g}" for factor in scales)


def write_detections(path: Path, split: DetectSplit, detections: list[Detections]) -> None:
    """Write the table frame_id, x0_px, y0_px, x1_px, y1_px, score and ELLIPSE_COLUMNS, one row per detection."""
    every = joined_detections(detections)
    names = np.repeat(split.frames.table["frame_id"].to_numpy(), [len(part.scores) for part in detections])
    columns = {"frame_id": pa.array(names, pa.string())}
    columns |= {name: pa.array(every.boxes[:, k]) for k, name in enumerate(("x0_px", "y0_px", "x1_px", "y1_px"))}
    columns["score"] = pa.array(every.scores)
    columns |= {name: pa.array(values, from_pandas=True) for name, values in ellipse_columns(every).items()}
    with written_aside(path) as aside:
        pq.write_table(pa.table(columns), aside, compression="zstd")
