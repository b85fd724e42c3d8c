"""Precision, recall, F1 and average precision of judged detections (matching.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.matching import COCO_IOUS, FALSE, FOUND, IGNORED, Matches

Array = NDArray[np.float64]


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

    def operating_threshold(self, min_precision: float | None) -> tuple[float, str]:
        """A score (0 to 1) as threshold and its name: of best F1, or of most recall at a precision of min_precision.

        Where no threshold has that precision, best F1 decides again, and the words say so.
        """
        if min_precision is None:
            return self.best_threshold(), "of best F1"
        # Of equal scores a threshold keeps all: only the last of them is a point where one can stand.
        ends = np.append(np.diff(self.scores) != 0, True)[: len(self.scores)]
        precise = np.flatnonzero(ends & (self.precision >= min_precision))
        if not len(precise):
            return self.best_threshold(), f"of best F1, since none has a precision of {min_precision:g},"
        return float(self.scores[precise[-1]]), f"of most recall at a precision of {min_precision:g}"


def f1_score(precision: Array, recall: Array) -> Array:
    """2 P R / (P + R), 0 where both are 0."""
    total = np.asarray(precision + recall, np.float64)
    return np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)


def curve(matches: Matches) -> Curve:
    """The precision-recall curve of all counted detections. Without wanted labels recall is 0."""
    counted = matches.outcome != IGNORED
    order = np.argsort(-matches.scores[counted], kind="stable")
    hits = np.cumsum(matches.outcome[counted][order] == FOUND)
    wanted = max(len(matches.wanted_frame), 1)
    return Curve(matches.scores[counted][order], hits / np.arange(1, len(hits) + 1), hits / wanted)


def at_threshold(matches: Matches, threshold: float) -> tuple[float, float, float]:
    """Precision, recall and F1 of the detections with a score of at least `threshold`; 0 where undefined."""
    strong = matches.scores >= threshold
    hits, false = (int((matches.outcome[strong] == kind).sum()) for kind in (FOUND, FALSE))
    precision = hits / max(hits + false, 1)
    recall = hits / max(len(matches.wanted_frame), 1)
    return precision, recall, float(f1_score(np.array(precision), np.array(recall)))


def figures(matches: Matches, threshold: float) -> dict[str, float]:
    """ap50 (all points), ap50_101 (COCO's), precision, recall and f1, each also strict, under their keys."""
    return figures_of_account(matches, threshold, "") | figures_of_account(matches.strict(), threshold, "strict/")


def figures_of_account(matches: Matches, threshold: float, prefix: str) -> dict[str, float]:
    """The five figures of one account under their keys with a prefix."""
    points = curve(matches)
    precision, recall, f1 = at_threshold(matches, threshold)
    return {
        f"{prefix}ap50": points.average_precision(),
        f"{prefix}ap50_101": points.average_precision_101(),
        f"{prefix}precision": precision,
        f"{prefix}recall": recall,
        f"{prefix}f1": f1,
    }


def figures_over_ious(by_iou: Sequence[Matches]) -> dict[str, float]:
    """ap50_95, ap50_95_101 and ap75, ap75_101 of matches at COCO_IOUS."""
    curves = [curve(matches) for matches in by_iou]
    at_75 = curves[COCO_IOUS.index(0.75)]
    return {
        "ap50_95": float(np.mean([points.average_precision() for points in curves])),
        "ap50_95_101": float(np.mean([points.average_precision_101() for points in curves])),
        "ap75": at_75.average_precision(),
        "ap75_101": at_75.average_precision_101(),
    }
