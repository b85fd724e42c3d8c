"""Compare scores with the share of detections that match a label: expected calibration error, reliability diagram.

Definition of a match: the usual scoring rule (matching.py). Only detections count whose outcome the labels can decide:
detections on ignored craters, outside the range of radii or centred off the image are left out, whether they match a
selected label or not. (The usual rule of AP keeps the matching ones among them; here this would raise the share of
matches just outside the range.)
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from perilune_train.detect.evaluate.matching import FOUND, IGNORED, NO_LABEL, Matches, Overlaps
from perilune_train.records.pictures import save_figure

Array = NDArray[np.float64]
BINS = 15
"""Number of bins of an expected calibration error."""
NAMES = {
    "ece": "usual rule, 15 bins of equal numbers of detections (the headline)",
    "ece_equal_width": "usual rule, 15 bins of equal width",
    "ece_above_threshold": "usual rule, detections at or above the threshold, 15 bins of equal numbers",
    "strict/ece": "strict rule: every unmatched detection is false",
    "any_label/ece": "a match with any label counts, selected or ignored; every other detection is false",
}
"""Expected calibration errors of an evaluation, and what each compares."""


@dataclass(frozen=True)
class ScoredMatches:
    """Scores of detections, and whether each matches a label."""

    scores: Array
    """Scores (D,)."""
    matched: NDArray[np.bool_]
    """Whether each detection matches a label (D,)."""

    def above(self, threshold: float) -> "ScoredMatches":
        """The detections with a score of at least `threshold`."""
        strong = self.scores >= threshold
        return ScoredMatches(self.scores[strong], self.matched[strong])


def decided_matches(overlaps: Overlaps, matches: Matches, radius_px: tuple[float, float]) -> ScoredMatches:
    """Detections that the labels can decide by the usual rule; `radius_px` is the evaluated range of radii."""
    radius = overlaps.radius_px()
    inside = (radius >= radius_px[0]) & (radius <= radius_px[1]) & ~overlaps.off_image
    decided = inside & (matches.outcome != IGNORED)
    return ScoredMatches(matches.scores[decided], matches.outcome[decided] == FOUND)


def calibration_errors(
    overlaps: Overlaps, matches: Matches, radius_px: tuple[float, float], threshold: float
) -> dict[str, float]:
    """The errors of NAMES by key; NaN without detections."""
    usual = decided_matches(overlaps, matches, radius_px)
    any_label = ScoredMatches(matches.scores, matches.label != NO_LABEL)
    strict = ScoredMatches(matches.scores, matches.outcome == FOUND)
    return {
        "ece": expected_calibration_error(usual),
        "ece_equal_width": expected_calibration_error(usual, equal_width=True),
        "ece_above_threshold": expected_calibration_error(usual.above(threshold)),
        "strict/ece": expected_calibration_error(strict),
        "any_label/ece": expected_calibration_error(any_label),
    }


def reliability(detections: ScoredMatches, equal_width: bool = False, bins: int = BINS) -> tuple[Array, Array, Array]:
    """Mean score, share of matches, and number of detections of each bin that is not empty (B,).

    Bins hold equal numbers of detections in order of score; with `equal_width`, each is 1 / `bins` of the range 0 to 1.
    """
    order = np.argsort(detections.scores, kind="stable")
    scores, matched = detections.scores[order], detections.matched[order]
    if equal_width:
        bounds = np.searchsorted(scores, np.linspace(0, 1, bins + 1)[1:-1])
    else:
        bounds = np.rint(np.linspace(0, len(scores), bins + 1)[1:-1]).astype(int)
    parts = [part for part in np.split(np.arange(len(scores)), bounds) if len(part)]
    return (
        np.array([scores[part].mean() for part in parts]),
        np.array([matched[part].mean() for part in parts]),
        np.array([float(len(part)) for part in parts]),
    )


def expected_calibration_error(detections: ScoredMatches, equal_width: bool = False, bins: int = BINS) -> float:
    """Mean over detections of |mean score - share of matches| of the detection's bin; NaN without detections.

    Naeini, Cooper and Hauskrecht, 2015, "Obtaining Well Calibrated Probabilities Using Bayesian Binning".
    """
    mean, share, count = reliability(detections, equal_width, bins)
    return float(np.average(np.abs(mean - share), weights=count)) if len(count) else float("nan")


def draw_reliability(detections: ScoredMatches, path: Path) -> None:
    """Draw the share of matches against the mean score of both kinds of bins, and a histogram of the scores."""
    figure = Figure(figsize=(5.2, 5.6), layout="constrained")
    axes, below = figure.subplots(2, 1, height_ratios=[3, 1], sharex=True)
    axes.plot([0, 1], [0, 1], color="#808080", linewidth=0.8)
    for equal_width, style, name in ((False, "o-", "bins of equal numbers"), (True, "x--", "bins of equal width")):
        mean, share, _ = reliability(detections, equal_width)
        axes.plot(mean, share, style, markersize=4, linewidth=1, label=name)
    axes.legend(loc="upper left", fontsize=8)
    error = expected_calibration_error(detections)
    axes.set(ylabel="share that matches a label", xlim=(0, 1), ylim=(0, 1))
    title = f"{len(detections.scores)} detections in {BINS} bins; expected calibration error {error:.3f}"
    axes.set_title(title, fontsize=9)
    axes.grid(alpha=0.3)
    below.hist(detections.scores, bins=np.linspace(0, 1, 31).tolist(), color="#3b7dd8")
    below.set(xlabel="score", ylabel="detections", yscale="log" if len(detections.scores) else "linear")
    save_figure(path, figure)
