"""Compute all metrics of detections, on plain arrays; works for rendered datasets and for real images.

    evaluation = evaluate_detections(detections, labels, facts, Criteria(threshold, radius_px=(2.0, 50.0)))
    figures = evaluation.figures()                       # flat keys, for metrics.json
    write_evaluation(folder, evaluation, images, about)  # report.py: report.md, pictures

`detections` is a list of Detections, `labels` a list of FrameLabels, and `facts` a FrameFacts (`unknown_facts` if
nothing is known). Each has one entry per frame. In real images all craters are labelled, and the ellipse of a label is
inscribed in its box.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.data.frame_facts import FrameFacts
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.bins import BinFigures, figures_by_bin
from perilune_train.detect.evaluate.bootstrap import at_threshold_resampled, average_precisions
from perilune_train.detect.evaluate.ellipse_score import ellipse_score
from perilune_train.detect.evaluate.matching import (
    COCO_IOUS,
    FALSE,
    FOUND,
    IGNORED,
    Criteria,
    Detections,
    Matches,
    Overlaps,
    edge_range,
    find_overlaps,
)
from perilune_train.detect.evaluate.metrics import figures, figures_of_rule, figures_over_ious
from perilune_train.detect.evaluate.reliability import ScoredMatches, calibration_errors, decided_matches
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import Resamples, Spread, draw_resamples, spreads

Array = NDArray[np.float64]
_LARGE_PX = 5.0
"""Craters above this radius have separate errors: smaller craters are limited by the pixels."""


@dataclass(frozen=True)
class Evaluation:
    """Evaluated detections, with all values that a report prints."""

    found: list[Detections]
    """Detections, one entry per frame."""
    labels: Sequence[FrameLabels]
    """Labels, one entry per frame."""
    facts: FrameFacts
    """Metadata of the frames."""
    threshold: float
    """Minimum score of the detections that count in precision, recall and F1."""
    match_iou: float
    """Minimum IoU of a match, except in averages over several IoUs."""
    overlaps: Overlaps
    """Pairs of detections and labels that may match."""
    matches: Matches
    """Matches at match_iou."""
    at_edge: Matches
    """Matches at match_iou by the edge scoring rule (matching.py)."""
    by_iou: list[Matches]
    """Matches at each of COCO_IOUS."""
    decided_matches: ScoredMatches
    """Detections that the labels can decide, for calibration errors (reliability.py)."""
    calibration_errors: dict[str, float]
    """Expected calibration errors by the keys of `reliability.NAMES`."""
    bins: list[BinFigures]
    """Metrics by radius, altitude, Sun elevation and freshness, for bins that hold selected labels."""
    spreads: dict[str, Spread]
    """Spreads of ap50_paper, ap50_95_paper, precision, recall and f1, and of ap50_paper by the edge and strict scoring
    rules."""
    resamples: Resamples
    """Resamples of the bootstrap intervals."""

    @cached_property
    def errors(self) -> dict[str, float]:
        """Centre and radius errors of the detected craters; see `errors_of_found`."""
        return errors_of_found(self.overlaps, self.matches, self.threshold)

    @cached_property
    def ellipse_errors(self) -> dict[str, float]:
        """Errors of the ellipses of detected craters; see `ellipse_errors_of_found`."""
        return ellipse_errors_of_found(self.overlaps, self.matches, self.threshold)

    @cached_property
    def ellipse_scores(self) -> dict[str, float]:
        """NASA's score (ellipse_score.py) of the detections above the threshold: ellipse_score, strict/ellipse_score.

        The truth is the selected labels. The first score does not count detections that the usual scoring rule
        ignores; the strict score counts all detections.
        """
        overlaps, matches, n_frames = self.overlaps, self.matches, len(self.facts)
        strong, area = self.matches.scores >= self.threshold, overlaps.ellipses[:, 3] > 0
        truth = _by_frame(overlaps.label_ellipses, overlaps.label_frame, overlaps.label_selected, n_frames)
        scores = {}
        for key, counted in (("", matches.outcome != IGNORED), ("strict/", np.ones(len(strong), bool))):
            found = _by_frame(overlaps.ellipses, overlaps.frame, strong & area & counted, n_frames)
            scores[f"{key}ellipse_score"] = ellipse_score(found, truth)
        return scores

    def figures(self) -> Metrics:
        """Entries of metrics.json; NaN where undefined.

        The keys come from `metrics.figures`, `figures_over_ious`, `Spread.keys`, `errors` and `reliability.NAMES`.
        Further keys are <bin>/ap50_paper and other metrics of each bin, recall_radius_... and lowest_ap50_paper_by_...
        """
        result: Metrics = {
            **figures(self.matches, self.threshold),
            **figures_of_rule(self.at_edge, self.threshold, "edge/"),
            **figures_over_ious(self.by_iou),
            "threshold": self.threshold,
            "match_iou": self.match_iou,
            "frames": len(self.facts),
            "labels": len(self.matches.selected_frame),
            "intervals_over": self.resamples.unit,
            "intervals_units": self.resamples.count,
            **self.errors,
            **self.ellipse_errors,
            **self.ellipse_scores,
            **self.calibration_errors,
        }
        for name, spread in self.spreads.items():
            result |= spread.keys(name)
        for part in self.bins:
            result |= {f"{part.key}/recall": part.recall, f"{part.key}/labels": part.labels}
            if part.by != "depth_ratio":
                result |= {f"{part.key}/{name}": getattr(part, name) for name in ("ap50_paper", "precision", "f1")}
                result |= part.ap50_paper_spread.keys(f"{part.key}/ap50_paper")
            if part.by == "radius":
                result[f"recall_{part.key}"] = part.recall
        for by in ("radius", "altitude", "sun"):
            aps = [part.ap50_paper for part in self.bins if part.by == by]
            result[f"lowest_ap50_paper_by_{by}"] = min(aps, default=None)
        return result

    def frame_f1(self) -> Array:
        """F1 of every frame (N,) at the threshold; NaN without selected labels."""
        n_frames = len(self.facts)
        strong = self.matches.scores >= self.threshold
        hits, false = (
            np.bincount(self.matches.frame[strong & (self.matches.outcome == kind)], minlength=n_frames)
            for kind in (FOUND, FALSE)
        )
        n_labels = np.bincount(self.matches.selected_frame, minlength=n_frames)
        return np.divide(2 * hits, hits + false + n_labels, out=np.full(n_frames, np.nan), where=n_labels > 0)


def evaluate_detections(
    detections: list[Detections],
    labels: Sequence[FrameLabels],
    facts: FrameFacts,
    criteria: Criteria,
    seed: int = 0,
) -> Evaluation:
    """Evaluate the detections of all frames.

    The edge scoring rule is valid only if `labels` include the craters down to EDGE times the smallest radius and
    somewhat smaller, as ignored labels. `seed` is the random seed of the bootstrap.
    """
    match_iou, radius_px, threshold = criteria.match_iou, criteria.radius_px, criteria.threshold
    overlaps = find_overlaps(detections, labels, facts.sizes_px, min(match_iou, *COCO_IOUS))
    matches = overlaps.match(match_iou, radius_px)
    at_edge = overlaps.match(match_iou, edge_range(radius_px))
    by_iou = [overlaps.match(iou, radius_px) for iou in COCO_IOUS]
    resamples = draw_resamples(facts.scene, facts.trajectory, facts.name, np.random.default_rng(seed))

    def statistics(drawn: Resamples) -> dict[str, Array]:
        return {
            "ap50_paper": average_precisions(matches, drawn),
            "edge/ap50_paper": average_precisions(at_edge, drawn),
            "strict/ap50_paper": average_precisions(matches.strict(), drawn),
            "ap50_95_paper": np.mean([average_precisions(part, drawn) for part in by_iou], axis=0),
            **at_threshold_resampled(matches, threshold, drawn),
        }

    return Evaluation(
        detections,
        labels,
        facts,
        threshold,
        match_iou,
        overlaps,
        matches,
        at_edge,
        by_iou,
        decided_matches(overlaps, matches, radius_px),
        calibration_errors(overlaps, matches, radius_px, threshold),
        figures_by_bin(overlaps, matches, facts, criteria, resamples),
        spreads(statistics, matches.selected_frame, resamples),
        resamples,
    )


def errors_of_found(overlaps: Overlaps, matches: Matches, threshold: float) -> dict[str, float]:
    """Errors of the centres and radii of detected craters; NaN without detections.

    Errors are in pixels (`_px`) or divided by the label's radius (`_relative`). The centre of a crater is the centre of
    its box, and the radius is sqrt(w h) / 2 of the box, for detections and labels alike. For a rotated ellipse this
    radius is slightly larger than sqrt(a b), which a box does not determine. The bias is the mean of detected minus
    true radius.
    """
    hits = (matches.label >= 0) & (matches.scores >= threshold)
    ours, truth = overlaps.boxes[hits], overlaps.label_boxes[matches.label[hits]]
    radius, true_radius = (np.sqrt(np.prod(box[:, 2:] - box[:, :2], axis=1)) / 2 for box in (ours, truth))
    centre_error = np.linalg.norm((ours[:, :2] + ours[:, 2:] - truth[:, :2] - truth[:, 2:]) / 2, axis=1)
    difference = radius - true_radius
    result: dict[str, float] = {}
    for ending, scale in (("px", np.ones_like(true_radius)), ("relative", true_radius)):
        for name, values in (("centre", centre_error / scale), ("radius", np.abs(difference) / scale)):
            result[f"{name}_error_{ending}_median"] = _or_nan(values, np.median)
            result[f"{name}_error_{ending}_p95"] = _or_nan(values, lambda known: np.percentile(known, 95))
        result[f"radius_bias_{ending}"] = _or_nan(difference / scale, np.mean)
    return result


def ellipse_errors_of_found(overlaps: Overlaps, matches: Matches, threshold: float) -> dict[str, float]:
    """Errors of the ellipses of detected craters; NaN without detections.

    - centre_error_px_rms: root mean square of the distance between the centres; with _above_5_px, of the labels with a
      radius above 5 px, also as centre_error_px_median_above_5_px
    - semi_major_error_px_..., semi_minor_error_px_...: median and root mean square of the error of a semi-axis
    - centre_normalised_error_squared, axes_normalised_error_squared: mean of (error / predicted standard deviation)^2
      over x and y, or over both semi-axes; 1 if the deviations are right, larger if they are too small. NaN if the
      detector predicts none. Also with _above_5_px.
    """
    hits = (matches.label >= 0) & (matches.scores >= threshold)
    label = matches.label[hits]
    error = overlaps.ellipses[hits, :4] - overlaps.label_ellipses[label, :4]
    squared = (error / overlaps.sigmas_px[hits]) ** 2
    distance, large = np.linalg.norm(error[:, :2], axis=1), overlaps.label_radius_px[label] > _LARGE_PX
    result = {
        "centre_error_px_rms": _or_nan(distance, _rms),
        "centre_error_px_rms_above_5_px": _or_nan(distance[large], _rms),
        "centre_error_px_median_above_5_px": _or_nan(distance[large], np.median),
    }
    for name, values in (("semi_major", error[:, 2]), ("semi_minor", error[:, 3])):
        result[f"{name}_error_px_median"] = _or_nan(np.abs(values), np.median)
        result[f"{name}_error_px_rms"] = _or_nan(values, _rms)
    for ending, rows in (("", slice(None)), ("_above_5_px", large)):
        result[f"centre_normalised_error_squared{ending}"] = _or_nan(squared[rows, :2], np.mean)
        result[f"axes_normalised_error_squared{ending}"] = _or_nan(squared[rows, 2:], np.mean)
    return result


def _by_frame(values: Array, frame: NDArray[np.intp], chosen: NDArray[np.bool_], n_frames: int) -> list[Array]:
    """The chosen rows of each frame; `frame` (N,) ascends."""
    kept = frame[chosen]
    return np.split(values[chosen], np.searchsorted(kept, np.arange(1, n_frames))) if n_frames else []


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _or_nan(values: Array, statistic) -> float:
    return float(statistic(values)) if len(values) else float("nan")
