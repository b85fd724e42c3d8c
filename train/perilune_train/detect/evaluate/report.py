"""Output files of an evaluation: report.md, pictures, and the precision-recall curve as a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from perilune_shared.storage.files import written_aside
from perilune_train.detect.evaluate.bins import BinFigures
from perilune_train.detect.evaluate.evaluation import Evaluation
from perilune_train.detect.evaluate.matching import COCO_IOUS, EDGE
from perilune_train.detect.evaluate.metrics import Curve, curve
from perilune_train.detect.evaluate.pictures import draw_bins, draw_curves, draw_frames
from perilune_train.detect.evaluate.reliability import NAMES, draw_reliability
from perilune_train.records.markdown import number, table, write_markdown
from perilune_train.records.spread import MIN_UNITS, RESAMPLES, Resamples, Spread

CURVE_FILE = "precision_recall.parquet"
_CURVE_POINTS = 1000
_ROWS = {
    "ap50_paper": "AP (the paper's sum)",
    "ap50_envelope": "AP, interpolated at all points",
    "ap50_coco101": "AP, COCO's 101 points",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
}


def write_evaluation(
    folder: Path, evaluation: Evaluation, images: Sequence[NDArray[np.uint8]], about: Sequence[str]
) -> None:
    """Write report.md, precision_recall.png and .parquet, reliability.png, bins.png and detections.png.

    `images` are the grey frames (height, width); the Markdown lines `about` state what was evaluated and how.
    """
    write_markdown(folder / "report.md", markdown(evaluation, about))
    curves = {f"IoU {COCO_IOUS[k]:.1f}": curve(evaluation.by_iou[k]) for k in (0, 2, 4, 6, 8)}
    others = {"edge": evaluation.at_edge, "strict": evaluation.matches.strict()}
    dashed = {f"IoU {evaluation.match_iou:g}, {name}": curve(matches) for name, matches in others.items()}
    draw_curves(_with_ap(curves), folder / "precision_recall.png", dashed=_with_ap(dashed))
    write_curve(folder / CURVE_FILE, curve(evaluation.matches))
    draw_reliability(evaluation.decided_matches, folder / "reliability.png")
    draw_bins(evaluation.bins, folder / "bins.png")
    draw_frames(evaluation, images, folder / "detections.png")


def _with_ap(curves: dict[str, Curve]) -> dict[str, Curve]:
    return {f"{name}: AP {points.ap_paper():.3f}": points for name, points in curves.items()}


def write_curve(path: Path, points: Curve) -> None:
    """Write the table score, precision, recall: at most 1000 points, evenly spaced along the curve."""
    count = len(points.scores)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _CURVE_POINTS)).astype(int)) if count else np.empty(0, int)
    columns = {name: pa.array(getattr(points, f)[chosen]) for name, f in _CURVE_COLUMNS.items()}
    with written_aside(path) as aside:
        pq.write_table(pa.table(columns), aside, compression="zstd")


_CURVE_COLUMNS = {"score": "scores", "precision": "precision", "recall": "recall"}


def markdown(evaluation: Evaluation, about: Sequence[str]) -> str:
    """The whole report as Markdown; the lines `about` state what was evaluated and how."""
    figures, spreads = evaluation.figures(), evaluation.spreads
    fullest = max((len(part.scores) for part in evaluation.found), default=0)
    lines = ["# Evaluation of crater detection", "", *[f"- {line}" for line in about]]
    lines += [
        f"- {figures['frames']} frames, {figures['labels']} selected labels; most detections in one frame: {fullest}",
        f"- match at IoU {evaluation.match_iou:g}; precision, recall and F1 at a score of {evaluation.threshold:.4f}",
        f"- {spread_note(evaluation.resamples)}",
        "- usual: unmatched detections on ignored craters, outside the range of radii, or centred off the image are "
        f"ignored; edge: as usual, but the range of radii of detections starts at {EDGE:g} of the smallest radius; "
        "strict: every unmatched detection is a false positive",
        "",
        "## All frames",
        "",
    ]
    rows = [
        [title, *(spread_cell(figures, spreads, f"{prefix}{key}") for prefix in ("", "edge/", "strict/"))]
        for key, title in _ROWS.items()
    ]
    rows += [
        ["AP over IoU 0.50:0.95", spread_cell(figures, spreads, "ap50_95_paper"), "", ""],
        ["AP over IoU 0.50:0.95, COCO's 101 points", number(figures["ap50_95_coco101"]), "", ""],
        ["AP at IoU 0.75", number(figures["ap75_paper"]), "", ""],
    ]
    lines += [*table(["metric", "usual", "edge", "strict"], rows), ""]
    lines += ["AP alone means the paper's AP: the sum of (R_n - R_(n-1)) P_n over all thresholds.", ""]
    lines += bin_tables(evaluation)
    lines += ["## Errors of detected craters", ""]
    errors = evaluation.errors
    rows = [
        [name, *(number(errors[f"{key}_{ending}{statistic}"]) for ending in ("px", "relative"))]
        for name, key, statistic in (
            ("centre, median", "centre_error", "_median"),
            ("centre, 95th percentile", "centre_error", "_p95"),
            ("radius, median", "radius_error", "_median"),
            ("radius, 95th percentile", "radius_error", "_p95"),
            ("radius, bias (detected minus true)", "radius_bias", ""),
        )
    ]
    lines += [*table(["error", "px", "relative to the radius"], rows), "", *_ellipses(evaluation)]
    lines += ["## Scores as probabilities", ""]
    lines += ["Expected calibration error: mean difference of score and share of matches; see reliability.png.", ""]
    rows = [[title, number(evaluation.calibration_errors[key])] for key, title in NAMES.items()]
    lines += [*table(["detections, match and bins", "expected calibration error"], rows), ""]
    return "\n".join(lines)


def _ellipses(evaluation: Evaluation) -> list[str]:
    """Lines of the section about ellipses."""
    errors, scores = evaluation.ellipse_errors, evaluation.ellipse_scores
    rows = [
        [name, number(errors[key]), number(errors[f"{key}_above_5_px"]) if f"{key}_above_5_px" in errors else ""]
        for name, key in (
            ("centre, r.m.s., px", "centre_error_px_rms"),
            ("semi-major axis, median, px", "semi_major_error_px_median"),
            ("semi-major axis, r.m.s., px", "semi_major_error_px_rms"),
            ("semi-minor axis, median, px", "semi_minor_error_px_median"),
            ("semi-minor axis, r.m.s., px", "semi_minor_error_px_rms"),
            ("centre, (error / standard deviation)^2, mean", "centre_normalised_error_squared"),
            ("semi-axes, (error / standard deviation)^2, mean", "axes_normalised_error_squared"),
        )
    ]
    median = number(errors["centre_error_px_median_above_5_px"])
    rows.insert(0, ["centre, median, px", number(evaluation.errors["centre_error_px_median"]), median])
    score, strict = (number(scores[key]) for key in ("ellipse_score", "strict/ellipse_score"))
    return [
        "## Ellipses of detected craters",
        "",
        f"Score of NASA's Crater Detection Challenge (0 to 100): {score}; strict: {strict}.",
        "",
        *table(["error", "all", "radius above 5 px"], rows),
        "",
    ]


def bin_tables(evaluation: Evaluation) -> list[str]:
    """Lines of the tables by radius, altitude, Sun elevation and freshness, each below its heading."""
    lines = []
    for by, title in (("radius", "Radius"), ("altitude", "Altitude"), ("sun", "Sun elevation")):
        lines += _bins(title, [part for part in evaluation.bins if part.by == by])
    return lines + _freshness([part for part in evaluation.bins if part.by == "depth_ratio"])


def spread_cell(figures: Mapping[str, object], spreads: Mapping[str, Spread], key: str) -> str:
    """A figure and, if known, its spread."""
    value = figures[key]
    known = key in spreads and isinstance(value, int | float)
    return spreads[key].text(value) if known else number(value)  # type: ignore[arg-type]


def spread_note(resamples: Resamples) -> str:
    """Explanation of the brackets after a number, for reports."""
    count, unit = resamples.count, resamples.unit
    plural = "trajectories" if unit == "trajectory" else f"{unit}s"
    if count < MIN_UNITS:
        return f"in brackets: the value of each {unit}; at least {MIN_UNITS} {plural} are needed for an interval"
    return (
        f"in brackets: 95 % bootstrap intervals ({RESAMPLES} resamples of {count} {plural}), or the value of each "
        f"{unit} if fewer than {MIN_UNITS} have labels"
    )


def _bins(title: str, parts: list[BinFigures]) -> list[str]:
    if not parts:
        return []
    rows = [
        [
            part.label,
            str(part.frames),
            str(part.labels),
            part.ap50_paper_spread.text(part.ap50_paper),
            number(part.precision),
            part.recall_spread.text(part.recall),
            number(part.f1),
        ]
        for part in parts
    ]
    lowest = min(parts, key=lambda part: part.ap50_paper)
    return [
        f"## {title}",
        "",
        f"Lowest AP: {number(lowest.ap50_paper)} at {lowest.label}.",
        "",
        *table([title.lower(), "frames", "labels", "AP", "precision", "recall", "F1"], rows),
        "",
    ]


def _freshness(parts: list[BinFigures]) -> list[str]:
    if not parts:
        return []
    rows = [[part.label, str(part.labels), part.recall_spread.text(part.recall)] for part in parts]
    return [
        "## Freshness",
        "",
        "Depth over diameter. It is unknown for false positives, so only recall is defined.",
        "",
        *table(["depth over diameter", "labels", "recall"], rows),
        "",
    ]
