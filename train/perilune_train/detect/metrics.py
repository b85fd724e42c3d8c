"""Matching of detections to labels; precision, recall, F1 and average precision.

A detection is taken in order of score and finds the free label of highest IoU, if that is at least `match_iou`.
Two accounts are kept. The usual one leaves out what no one can judge: a detection that finds no wanted label is
not counted where it lies on an ignored crater (hardly visible, or just outside the labelled range), where its
radius sqrt(w h) / 2 is outside the labelled range, or where its centre is off the image. The strict one leaves out
nothing: all these are false. In both only wanted labels are to be found.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.boxes import iou_matrix
from perilune_train.detect.data import FrameLabels

Array = NDArray[np.float64]
FOUND, FALSE, IGNORED = 1, 0, -1


@dataclass(frozen=True)
class Detections:
    """Detections of one frame, best first."""

    boxes: Array
    """x0, y0, x1, y1 in pixels (D, 4)."""
    scores: Array
    """(D,), in (0, 1)."""


@dataclass(frozen=True)
class Matches:
    """All detections of a split, judged."""

    scores: Array
    """(D,)."""
    outcome: NDArray[np.int8]
    """FOUND, FALSE or IGNORED (D,)."""
    found_radius_px: Array
    """Radius of the label that was found, NaN where none (D,)."""
    wanted_radius_px: Array
    """Radius of every wanted label (L,)."""

    def strict(self) -> "Matches":
        """The same with every ignored detection counted as false."""
        outcome = np.where(self.outcome == IGNORED, FALSE, self.outcome).astype(np.int8)
        return Matches(self.scores, outcome, self.found_radius_px, self.wanted_radius_px)


def match_frame(found: Detections, labels: FrameLabels, match_iou: float) -> NDArray[np.intp]:
    """For each detection the label it finds (D,): its row, -1 for none, -2 where it only lies on an ignored one."""
    overlap = iou_matrix(found.boxes, labels.boxes)
    free = np.array(labels.wanted, bool)
    result = np.full(len(overlap), -1, np.intp)
    if not len(labels.boxes):
        return result
    for i, row in enumerate(overlap):
        best = int(np.where(free, row, -1.0).argmax())
        if free[best] and row[best] >= match_iou:
            result[i] = best
            free[best] = False
        elif (row[~labels.wanted] >= match_iou).any():
            result[i] = -2
    return result


def match_split(
    found: list[Detections],
    labels: list[FrameLabels],
    image_size_px: tuple[int, int],
    match_iou: float,
    radius_px: tuple[float, float],
) -> Matches:
    """Judge the detections of all frames of a split; image_size_px is (width, height)."""
    scores, outcomes, radii = [], [], []
    for detections, truth in zip(found, labels, strict=True):
        label = match_frame(detections, truth, match_iou)
        centre = (detections.boxes[:, :2] + detections.boxes[:, 2:]) / 2
        radius = np.sqrt(np.prod(np.maximum(detections.boxes[:, 2:] - detections.boxes[:, :2], 0), axis=1)) / 2
        outside = (radius < radius_px[0]) | (radius > radius_px[1])
        outside |= ((centre < 0) | (centre >= np.array(image_size_px))).any(axis=1)
        outcomes.append(np.where(label >= 0, FOUND, np.where((label == -2) | outside, IGNORED, FALSE)))
        radii.append(np.where(label >= 0, np.append(truth.radius_px, np.nan)[label], np.nan))
        scores.append(detections.scores)
    wanted = np.concatenate([truth.radius_px[truth.wanted] for truth in labels])
    return Matches(np.concatenate(scores), np.concatenate(outcomes).astype(np.int8), np.concatenate(radii), wanted)


@dataclass(frozen=True)
class Curve:
    """Precision and recall as the score threshold falls."""

    scores: Array
    """Thresholds, falling (K,)."""
    precision: Array
    """(K,)."""
    recall: Array
    """(K,)."""

    def average_precision(self) -> float:
        """Area under the curve, sum of (R_n - R_(n-1)) P_n over all points (the paper's AP).

        P_n is the best precision at that recall or a higher one, as usual (all-point interpolation).
        """
        envelope = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float(np.sum(np.diff(self.recall, prepend=0.0) * envelope))

    def average_precision_101(self) -> float:
        """Mean of the interpolated precision at recalls 0, 0.01 .. 1 (COCO)."""
        envelope = np.append(np.maximum.accumulate(self.precision[::-1])[::-1], 0.0)
        return float(envelope[np.searchsorted(self.recall, np.linspace(0, 1, 101), side="left")].mean())

    def best_threshold(self) -> float:
        """The score at which F1 is highest, 1 without detections."""
        if not len(self.scores):
            return 1.0
        return float(self.scores[int(f1_score(self.precision, self.recall).argmax())])


def f1_score(precision: Array, recall: Array) -> Array:
    """2 P R / (P + R), 0 where both are 0."""
    total = np.asarray(precision + recall, np.float64)
    return np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)


def curve(matches: Matches) -> Curve:
    """The precision-recall curve of all counted detections. Without wanted labels recall is 0."""
    counted = matches.outcome != IGNORED
    order = np.argsort(-matches.scores[counted], kind="stable")
    hits = np.cumsum(matches.outcome[counted][order] == FOUND)
    wanted = max(len(matches.wanted_radius_px), 1)
    return Curve(matches.scores[counted][order], hits / np.arange(1, len(hits) + 1), hits / wanted)


def at_threshold(matches: Matches, threshold: float) -> tuple[float, float, float]:
    """Precision, recall and F1 of the detections with a score of at least `threshold`; 0 where undefined."""
    strong = matches.scores >= threshold
    hits, false = (int((matches.outcome[strong] == kind).sum()) for kind in (FOUND, FALSE))
    precision = hits / max(hits + false, 1)
    recall = hits / max(len(matches.wanted_radius_px), 1)
    return precision, recall, float(f1_score(np.array(precision), np.array(recall)))


RADIUS_BINS_PX = (2.0, 3.0, 5.0, 10.0, 20.0, 50.0)


def figures(matches: Matches, threshold: float) -> dict[str, float]:
    """ap50, ap50_101, precision, recall, f1, each also strict, and recall by radius, under their keys."""
    result: dict[str, float] = {}
    for prefix, account in (("", matches), ("strict/", matches.strict())):
        points = curve(account)
        precision, recall, f1 = at_threshold(account, threshold)
        result |= {
            f"{prefix}ap50": points.average_precision(),
            f"{prefix}ap50_101": points.average_precision_101(),
            f"{prefix}precision": precision,
            f"{prefix}recall": recall,
            f"{prefix}f1": f1,
        }
    found = matches.found_radius_px[(matches.outcome == FOUND) & (matches.scores >= threshold)]
    wanted_counts, _ = np.histogram(matches.wanted_radius_px, RADIUS_BINS_PX)
    found_counts, _ = np.histogram(found, RADIUS_BINS_PX)
    for low, high, hits, all_of_them in zip(
        RADIUS_BINS_PX, RADIUS_BINS_PX[1:], found_counts, wanted_counts, strict=False
    ):
        if all_of_them:
            result[f"recall_radius_{low:g}_{high:g}_px"] = float(hits / all_of_them)
    return result
