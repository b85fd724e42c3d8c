"""Precision, recall, F1 and average precision of matched detections (matching.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import COCO_IOUS, FALSE, FOUND, IGNORED, Matches

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """Precision-recall curve: precision and recall at decreasing score thresholds."""

    scores: Array
    """Thresholds, decreasing (K,)."""
    precision: Array
    """Precision at each threshold (K,)."""
    recall: Array
    """Recall at each threshold (K,)."""

    def ap_paper(self) -> float:
        """The paper's AP, the headline metric: sum of (R_n - R_(n-1)) P_n over all thresholds.

        P_n is the precision without interpolation. There is one threshold per distinct score, as in scikit-learn's
        average_precision_score, so equal scores count together. The result is never above `ap_envelope`.
        """
        ends = self._thresholds()
        return float(np.sum(np.diff(self.recall[ends], prepend=0.0) * self.precision[ends]))

    def ap_envelope(self) -> float:
        """All-point interpolated AP: P_n is replaced by the best precision at an equal or higher recall.

        Equal scores count one by one in the order of the detections, as in COCO's tools.
        """
        envelope = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float(np.sum(np.diff(self.recall, prepend=0.0) * envelope))

    def ap_coco101(self) -> float:
        """COCO's AP: mean of the interpolated precision at recalls 0, 0.01, ..., 1."""
        envelope = np.append(np.maximum.accumulate(self.precision[::-1])[::-1], 0.0)
        return float(envelope[np.searchsorted(self.recall, np.linspace(0, 1, 101), side="left")].mean())

    def _thresholds(self) -> NDArray[np.bool_]:
        """Which points (K,) are possible thresholds: of equal scores the last, since all are kept together."""
        return np.append(np.diff(self.scores) != 0, True)[: len(self.scores)]

    def best_threshold(self) -> float:
        """The score threshold of highest F1; 1 without detections."""
        if not len(self.scores):
            return 1.0
        return float(self.scores[int(f1_score(self.precision, self.recall).argmax())])

    def operating_threshold(self, min_precision: float | None) -> tuple[float, str]:
        """Score threshold (0 to 1) and its description: highest F1, or highest recall at `min_precision`.

        If no threshold reaches that precision, the threshold of the highest F1 is used, and the description says so.
        """
        if min_precision is None:
            return self.best_threshold(), "of highest F1"
        precise = np.flatnonzero(self._thresholds() & (self.precision >= min_precision))
        if not len(precise):
            return self.best_threshold(), f"of highest F1 (no threshold reaches a precision of {min_precision:g})"
        return float(self.scores[precise[-1]]), f"of highest recall at a precision of at least {min_precision:g}"


def f1_score(precision: Array, recall: Array) -> Array:
    """2 P R / (P + R), 0 where both are 0."""
    total = np.asarray(precision + recall, np.float64)
    return np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)


def curve(matches: Matches) -> Curve:
    """Precision-recall curve of all detections that are not ignored; recall is 0 without selected labels."""
    counted = matches.outcome != IGNORED
    order = np.argsort(-matches.scores[counted], kind="stable")
    hits = np.cumsum(matches.outcome[counted][order] == FOUND)
    n_labels = max(len(matches.selected_frame), 1)
    return Curve(matches.scores[counted][order], hits / np.arange(1, len(hits) + 1), hits / n_labels)


def at_threshold(matches: Matches, threshold: float) -> tuple[float, float, float]:
    """Precision, recall and F1 of the detections with a score of at least `threshold`; 0 where undefined."""
    strong = matches.scores >= threshold
    hits, false = (int((matches.outcome[strong] == kind).sum()) for kind in (FOUND, FALSE))
    precision = hits / max(hits + false, 1)
    recall = hits / max(len(matches.selected_frame), 1)
    return precision, recall, float(f1_score(np.array(precision), np.array(recall)))


def figures(matches: Matches, threshold: float) -> dict[str, float]:
    """Six metrics by key, by the usual and, with the prefix "strict/", by the strict scoring rule.

    The keys are ap50_paper, ap50_envelope, ap50_coco101, precision, recall and f1.
    """
    return figures_of_rule(matches, threshold, "") | figures_of_rule(matches.strict(), threshold, "strict/")


def figures_of_rule(matches: Matches, threshold: float, prefix: str) -> dict[str, float]:
    """The six metrics of `figures` by one scoring rule; `prefix` starts their keys."""
    points = curve(matches)
    precision, recall, f1 = at_threshold(matches, threshold)
    return {
        f"{prefix}ap50_paper": points.ap_paper(),
        f"{prefix}ap50_envelope": points.ap_envelope(),
        f"{prefix}ap50_coco101": points.ap_coco101(),
        f"{prefix}precision": precision,
        f"{prefix}recall": recall,
        f"{prefix}f1": f1,
    }


def figures_over_ious(by_iou: Sequence[Matches]) -> dict[str, float]:
    """AP averaged over COCO_IOUS (ap50_95_...) and AP at an IoU of 0.75 (ap75_...), in three definitions."""
    curves = [curve(matches) for matches in by_iou]
    at_75 = curves[COCO_IOUS.index(0.75)]
    return {
        "ap50_95_paper": float(np.mean([points.ap_paper() for points in curves])),
        "ap50_95_envelope": float(np.mean([points.ap_envelope() for points in curves])),
        "ap50_95_coco101": float(np.mean([points.ap_coco101() for points in curves])),
        "ap75_paper": at_75.ap_paper(),
        "ap75_envelope": at_75.ap_envelope(),
        "ap75_coco101": at_75.ap_coco101(),
    }
