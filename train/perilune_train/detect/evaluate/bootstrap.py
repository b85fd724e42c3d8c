"""Detection metrics in every bootstrap resample of scenes, trajectories or images (records/spread.py)."""

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import FOUND, IGNORED, Matches
from perilune_train.records.spread import Resamples

Array = NDArray[np.float64]
_GROUPS = 2000


def average_precisions(matches: Matches, resamples: Resamples) -> Array:
    """The paper's AP (`Curve.ap_paper`) of every resample (R,); NaN without selected labels.

    For speed, the sorted detections of each scene (trajectory, image) are counted in at most 2000 groups of similar
    scores, and the curve has one point per group. The result is exact for up to 2000 distinct scores. With more scores,
    the error is a few ten-thousandths.
    """
    counted = np.flatnonzero(matches.outcome != IGNORED)
    order = counted[np.argsort(-matches.scores[counted], kind="stable")]
    rank = np.cumsum(np.diff(matches.scores[order], prepend=np.inf) != 0) - 1
    n_scores = int(rank[-1]) + 1 if len(rank) else 0
    n_groups = min(_GROUPS, n_scores)
    group = rank * n_groups // max(n_scores, 1)
    cell = resamples.of_row[matches.frame[order]], group
    shape = (resamples.count, n_groups)
    hits, every = np.zeros(shape), np.zeros(shape)
    np.add.at(hits, cell, matches.outcome[order] == FOUND)
    np.add.at(every, cell, 1.0)
    hits, every = (np.cumsum(resamples.weights @ part, axis=1) for part in (hits, every))
    n_labels = resamples.totals(matches.selected_frame)
    precision = hits / np.maximum(every, 1)
    area = (np.diff(hits, axis=1, prepend=0.0) * precision).sum(axis=1)
    return np.divide(area, n_labels, out=np.full(len(n_labels), np.nan), where=n_labels > 0)


def at_threshold_resampled(matches: Matches, threshold: float, resamples: Resamples) -> dict[str, Array]:
    """Precision, recall and F1 of every resample (R,) at one threshold; NaN without selected labels."""
    strong = matches.scores >= threshold
    hits, counted = (
        resamples.totals(matches.frame[strong & chosen])
        for chosen in (matches.outcome == FOUND, matches.outcome != IGNORED)
    )
    n_labels = resamples.totals(matches.selected_frame)
    undefined = np.where(n_labels > 0, 0.0, np.nan)
    return {
        "precision": hits / np.maximum(counted, 1) + undefined,
        "recall": hits / np.maximum(n_labels, 1) + undefined,
        "f1": 2 * hits / np.maximum(counted + n_labels, 1) + undefined,
    }
