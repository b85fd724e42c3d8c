"""Metrics by crater size, altitude, Sun elevation and freshness.

Altitude and Sun elevation belong to a frame, so their bins hold whole frames. Radius belongs to a label, so its bins
follow COCO's rule for areas: detections are matched again while the labels of other bins are ignored, and an unmatched
detection is ignored if its radius is outside the bin. Freshness (depth over diameter) belongs to a label too. A false
positive has no freshness, so only recall is defined.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.data.frame_facts import FrameFacts
from perilune_train.detect.evaluate.bootstrap import at_threshold_resampled, average_precisions
from perilune_train.detect.evaluate.matching import Criteria, Matches, Overlaps
from perilune_train.detect.evaluate.metrics import at_threshold, curve
from perilune_train.records.spread import Resamples, Spread, spreads

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
RADIUS_BINS_PX = (2.0, 3.0, 5.0, 10.0, 20.0, 50.0, float("inf"))
"""Bins of the paper's range up to 50 px, and one open bin for the larger labels of wider images."""
_PAPER_MAX_RADIUS_PX = 50.0
ALTITUDE_BINS_M = (200.0, 500.0, 1000.0, 1500.0)
SUN_BINS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0)
DEPTH_RATIO_BINS = (0.0, 0.04, 0.06, 0.08, 0.1, 0.15, 1.0)
_ALTITUDE_MARGIN = 0.1


@dataclass(frozen=True)
class BinFigures:
    """Metrics of one bin, at the run's threshold; NaN where undefined."""

    by: str
    """radius, altitude, sun or depth_ratio."""
    unit: str
    """px, m, deg or empty."""
    low: float
    """Lower limit, included; excluded in the radius bin above 50 px."""
    high: float
    """Upper limit, excluded; included in the last bin and in the radius bin that ends at 50 px."""
    frames: int
    """Number of frames with a selected label in the bin."""
    labels: int
    """Number of selected labels."""
    ap50_paper: float
    """AP as defined in the paper (metrics.py)."""
    ap50_paper_spread: Spread
    """Spread of ap50_paper over the scenes (trajectories, images) with selected labels in the bin."""
    precision: float
    """Precision by the usual scoring rule (matching.py)."""
    recall: float
    """Fraction of the selected labels that were found."""
    recall_spread: Spread
    """Spread of recall over the same scenes (trajectories, images)."""
    f1: float
    """F1 at the threshold."""

    @property
    def key(self) -> str:
        """Key of the bin in metrics.json, for example radius_2_3_px."""
        return "_".join([self.by, f"{self.low:g}", f"{self.high:g}"] + [self.unit] * bool(self.unit))

    @property
    def label(self) -> str:
        """The bin's range as text, for example 2 to 3 px."""
        reach = f"{self.low:g} to {self.high:g}" if self.high < float("inf") else f"above {self.low:g}"
        return f"{reach} {self.unit}".rstrip()


def within(values: Array, low: float, high: float, last: bool) -> Flags:
    """Whether values are in a bin; False for NaN."""
    return (values >= low) & ((values <= high) if last else (values < high))


def figures_by_bin(
    overlaps: Overlaps,
    matches: Matches,
    facts: FrameFacts,
    criteria: Criteria,
    resamples: Resamples,
) -> list[BinFigures]:
    """Metrics of every bin that holds selected labels; `matches` must result from `criteria`.

    The lowest altitude bin includes frames up to a tenth below its lower limit, and the highest bin includes frames up
    to a tenth above its upper limit: trajectories end near the nominal altitude, not exactly at it.
    """
    bins, threshold, radius_px = [], criteria.threshold, criteria.radius_px
    for low, high in pairwise(RADIUS_BINS_PX):
        # A radius of exactly 50 px belongs to the paper's largest bin.
        in_bin = within(overlaps.label_radius_px, low, high, high == _PAPER_MAX_RADIUS_PX)
        in_bin &= (low < _PAPER_MAX_RADIUS_PX) | (overlaps.label_radius_px > low)
        evaluated = max(low, radius_px[0]), min(high, radius_px[1])
        part = overlaps.match(criteria.match_iou, evaluated, overlaps.label_selected & in_bin)
        bins.append(_of_matches(_Bin("radius", "px", low, high), part, threshold, resamples))
    margins = {ALTITUDE_BINS_M[0]: 1 - _ALTITUDE_MARGIN, ALTITUDE_BINS_M[-1]: 1 + _ALTITUDE_MARGIN}
    for low, high in pairwise(ALTITUDE_BINS_M):
        chosen = within(facts.altitude_m, low * margins.get(low, 1), high * margins.get(high, 1), high in margins)
        limits = _Bin("altitude", "m", low, high)
        bins.append(_of_matches(limits, matches.of_frames(chosen), threshold, resamples))
    for low, high in pairwise(SUN_BINS_DEG):
        chosen = within(facts.sun_elevation_deg, low, high, high == SUN_BINS_DEG[-1])
        limits = _Bin("sun", "deg", low, high)
        bins.append(_of_matches(limits, matches.of_frames(chosen), threshold, resamples))
    for low, high in pairwise(DEPTH_RATIO_BINS):
        in_bin = within(overlaps.label_depth_ratio, low, high, high == DEPTH_RATIO_BINS[-1]) & overlaps.label_selected
        bins.append(_of_labels(_Bin("depth_ratio", "", low, high), in_bin, overlaps, matches, threshold, resamples))
    return [part_bin for part_bin in bins if part_bin.labels]


class _Bin(NamedTuple):
    """Limits of a bin, as in `BinFigures`."""

    by: str
    unit: str
    low: float
    high: float


def _of_matches(limits: _Bin, matches: Matches, threshold: float, resamples: Resamples) -> BinFigures:
    precision, recall, f1 = at_threshold(matches, threshold)
    spread = spreads(
        lambda drawn: {
            "ap50_paper": average_precisions(matches, drawn),
            "recall": at_threshold_resampled(matches, threshold, drawn)["recall"],
        },
        matches.selected_frame,
        resamples,
    )
    return BinFigures(
        *limits,
        len(np.unique(matches.selected_frame)),
        len(matches.selected_frame),
        curve(matches).ap_paper(),
        spread["ap50_paper"],
        precision,
        recall,
        spread["recall"],
        f1,
    )


def _of_labels(
    limits: _Bin,
    in_bin: Flags,
    overlaps: Overlaps,
    matches: Matches,
    threshold: float,
    resamples: Resamples,
) -> BinFigures:
    """Recall of the labels `in_bin` (L,); the matches cover all labels."""
    hit = np.zeros(len(in_bin), np.bool_)
    hit[matches.label[(matches.label >= 0) & (matches.scores >= threshold)]] = True
    frames = overlaps.label_frame[in_bin]

    def recalls(drawn: Resamples) -> dict[str, Array]:
        n_found, n_labels = drawn.totals(overlaps.label_frame[in_bin & hit]), drawn.totals(frames)
        return {"recall": np.divide(n_found, n_labels, out=np.full(len(n_labels), np.nan), where=n_labels > 0)}

    nan = float("nan")
    recall = float(hit[in_bin].mean()) if in_bin.any() else nan
    return BinFigures(
        *limits,
        len(np.unique(frames)),
        len(frames),
        nan,
        Spread(resamples.unit, None),
        nan,
        recall,
        spreads(recalls, frames, resamples)["recall"],
        nan,
    )
