"""95 % intervals by bootstrap over scenes: whole scenes are drawn with replacement, since frames of one are alike.

A split with one scene is resampled by descents, with one descent by frames; images of which neither is known are
resampled one by one. Few scenes give rough intervals: two have only three different resamples.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.facts import FrameFacts
from perilune_train.detect.matching import FOUND, IGNORED, Matches

Array = NDArray[np.float64]
RESAMPLES = 1000
_GROUPS = 2000
_PERCENTILES = (2.5, 97.5)


@dataclass(frozen=True)
class Resamples:
    """How often each unit is in each resample."""

    unit: str
    """scene, descent or frame."""
    of_frame: NDArray[np.intp]
    """The unit of each frame (N,)."""
    weights: Array
    """(resamples, units)."""

    @property
    def count(self) -> int:
        """Units there are."""
        return self.weights.shape[1]


Interval = tuple[float, float]


def draw_resamples(facts: FrameFacts, rng: np.random.Generator, count: int = RESAMPLES) -> Resamples:
    """`count` resamples of the scenes of some frames; of descents or frames where there is one scene, one descent."""
    for unit, names in (("scene", facts.scene), ("descent", facts.descent), ("frame", facts.name)):
        _, of_frame = np.unique(np.asarray(names, dtype=str), return_inverse=True)
        n_units = int(of_frame.max(initial=-1)) + 1
        if n_units > 1 or unit == "frame":
            break
    weights = rng.multinomial(n_units, np.full(n_units, 1 / n_units), count) if n_units else np.zeros((count, 0))
    return Resamples(unit, of_frame.reshape(-1), weights.astype(np.float64))


def average_precisions(matches: Matches, resamples: Resamples) -> Array:
    """The paper's AP (`Curve.ap_paper`) of every resample (R,); NaN without wanted labels, see `resampled_wanted`.

    The sorted detections are counted by unit in at most 2000 groups of neighbouring scores, and a curve has one point
    per group: exact for that many distinct scores, else within a few ten-thousandths.
    """
    counted = np.flatnonzero(matches.outcome != IGNORED)
    order = counted[np.argsort(-matches.scores[counted], kind="stable")]
    rank = np.cumsum(np.diff(matches.scores[order], prepend=np.inf) != 0) - 1
    n_scores = int(rank[-1]) + 1 if len(rank) else 0
    n_groups = min(_GROUPS, n_scores)
    group = rank * n_groups // max(n_scores, 1)
    place = resamples.of_frame[matches.frame[order]], group
    shape = (resamples.count, n_groups)
    hits, every = np.zeros(shape), np.zeros(shape)
    np.add.at(hits, place, matches.outcome[order] == FOUND)
    np.add.at(every, place, 1.0)
    hits, every = (np.cumsum(resamples.weights @ part, axis=1) for part in (hits, every))
    wanted = resampled_wanted(matches.wanted_frame, resamples)
    precision = hits / np.maximum(every, 1)
    area = (np.diff(hits, axis=1, prepend=0.0) * precision).sum(axis=1)
    return np.divide(area, wanted, out=np.full(len(wanted), np.nan), where=wanted > 0)


def at_threshold_resampled(matches: Matches, threshold: float, resamples: Resamples) -> dict[str, Array]:
    """precision, recall and f1 of every resample (R,), at one score threshold; NaN without wanted labels."""
    strong = matches.scores >= threshold
    hits, counted = (
        resamples.weights @ _counts(matches.frame[strong & chosen], resamples)
        for chosen in (matches.outcome == FOUND, matches.outcome != IGNORED)
    )
    wanted = resampled_wanted(matches.wanted_frame, resamples)
    undefined = np.where(wanted > 0, 0.0, np.nan)
    return {
        "precision": hits / np.maximum(counted, 1) + undefined,
        "recall": hits / np.maximum(wanted, 1) + undefined,
        "f1": 2 * hits / np.maximum(counted + wanted, 1) + undefined,
    }


def interval(values: Array) -> Interval:
    """The middle 95 % of resampled figures (R,); NaN where fewer than two of them are defined."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return float("nan"), float("nan")
    low, high = np.percentile(known, _PERCENTILES)
    return float(low), float(high)


def resampled_wanted(frames: NDArray[np.intp], resamples: Resamples) -> Array:
    """Wanted labels in every resample (R,), from the frame of each (L,); all 0, so that no interval is told, where
    they lie in one unit alone: of how units differ it says nothing."""
    counts = _counts(frames, resamples)
    return resamples.weights @ counts if (counts > 0).sum() > 1 else np.zeros(len(resamples.weights))


def _counts(frames: NDArray[np.intp], resamples: Resamples) -> Array:
    return np.bincount(resamples.of_frame[frames], minlength=resamples.count).astype(np.float64)
