"""Recall and AP of a detector by the detectability d' of the labels, and the same figures of an ideal observer.

`perilune-render detectability` measures d' of every label. The decision model of the ideal observer: a frame has M
places at which it decides whether there is a crater. Its response is Gaussian with standard deviation 1, with mean d'
at a crater and mean 0 at a place without one, and it marks every place whose response exceeds a threshold t. The
expected recall is the mean of Phi(d' - t) over all labels, and M Phi(-t) false positives are expected in a frame. Phi
is the cumulative distribution of a Gaussian. M counts, for radii in steps of sqrt(2) over the evaluated range, the
circles of this radius that have the area of the image together (`places`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from perilune_shared.errors import UserError
from perilune_shared.storage.tables.limits import DETECTABILITIES
from perilune_shared.storage.tables.read import read_table
from perilune_train.detect.data.frame_facts import facts_of
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.bins import DEPTH_RATIO_BINS, RADIUS_BINS_PX, SUN_BINS_DEG, within
from perilune_train.detect.evaluate.matching import FALSE, Detections, Matches, Overlaps, find_overlaps
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.records.markdown import number, table, write_markdown

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
D_PRIME_BINS = (float("-inf"), 1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, float("inf"))
BOUNDS = (1.0, 2.0, 3.0, 4.0, 6.0)
"""Smallest d' of the selected labels of each AP."""
DETECTABILITY_FILE = "detectability.md"
_STEPS = 400


@dataclass(frozen=True, slots=True)
class Group:
    """Figures of the labels of one group, at the threshold of the run."""

    by: str
    """d_prime, radius, sun or depth_ratio; "all" for all labels."""
    low: float
    """Lower limit, included."""
    high: float
    """Upper limit, excluded except in the last group."""
    labels: int
    """Number of labels with a known d'."""
    d_prime: float
    """Median of d'."""
    recall: float
    """Share of the labels that the detector finds."""
    ideal_recall: float
    """Expected share of the labels that the ideal observer finds, with as many false positives per frame."""
    ap50_paper: float = float("nan")
    """AP of the detector over all labels; only for `all` and `sun`."""
    ideal_ap: float = float("nan")
    """AP of the ideal observer; only for `all` and `sun`."""

    @property
    def share(self) -> float:
        """Recall of the detector over the recall of the ideal observer."""
        return self.recall / self.ideal_recall if self.ideal_recall > 0 else float("nan")

    @property
    def share_of_ap(self) -> float:
        """AP of the detector over the AP of the ideal observer."""
        return self.ap50_paper / self.ideal_ap if self.ideal_ap > 0 else float("nan")

    @property
    def range(self) -> str:
        """The limits as text."""
        if self.by == "all":
            return "all"
        if not np.isfinite(self.low):
            return f"below {self.high:g}"
        return f"{self.low:g} to {self.high:g}" if np.isfinite(self.high) else f"above {self.low:g}"


@dataclass(frozen=True, slots=True)
class Above:
    """Figures over the labels above a bound of d'; all other labels are ignored."""

    bound: float
    """Smallest d' of the selected labels."""
    labels: int
    """Number of selected labels."""
    ap50_paper: float
    """AP by the usual scoring rule."""
    strict_ap: float
    """AP by the strict scoring rule, for which every unmatched detection is a false positive."""
    recall: float
    """Recall at the threshold of the run."""


@dataclass(frozen=True, slots=True)
class ByDetectability:
    """Figures of a detector by the detectability of the labels."""

    frames: int
    """Number of frames with a known d'."""
    threshold: float
    """Minimum score of the detections that count in recall."""
    false_positives: float
    """False positives per frame at the threshold, if all labels in the range of radii are selected."""
    places: float
    """Places per frame at which the ideal observer decides."""
    auc: float
    """Probability that a label that is found has a larger d' than a label that is missed."""
    groups: list[Group]
    """Figures of all labels and of each group."""
    above: list[Above]
    """AP over labels above bounds of d'."""

    def figures(self) -> dict[str, float | int]:
        """Flat keys for metrics.json."""
        every = self.groups[0]
        flat: dict[str, float | int] = {
            "detectability/frames": self.frames,
            "detectability/labels": every.labels,
            "detectability/auc": self.auc,
            "detectability/false_positives_per_frame": self.false_positives,
            "detectability/places_per_frame": self.places,
        }
        for group in self.groups:
            key = "detectability"
            if group.by != "all":
                key += f"/{group.by}_{group.low:g}_{group.high:g}"
                flat[f"{key}/labels"] = group.labels
            flat |= {f"{key}/recall": group.recall, f"{key}/ideal_recall": group.ideal_recall}
            flat[f"{key}/share_of_ideal_recall"] = group.share
            if np.isfinite(group.ap50_paper):
                flat |= {f"{key}/ap50_paper": group.ap50_paper, f"{key}/ideal_ap": group.ideal_ap}
                flat[f"{key}/share_of_ideal_ap"] = group.share_of_ap
        for part in self.above:
            key = f"detectability/above_{part.bound:g}"
            flat |= {f"{key}/labels": part.labels, f"{key}/ap50_paper": part.ap50_paper}
            flat |= {f"{key}/strict/ap50_paper": part.strict_ap, f"{key}/recall": part.recall}
        return {key: value for key, value in flat.items() if np.isfinite(value)}

    def markdown(self, about: Sequence[str]) -> str:
        """The report as Markdown; the lines `about` state what was evaluated and how."""
        lines = ["# Detection by detectability", "", *[f"- {line}" for line in about]]
        lines += [
            f"- {self.frames} frames, {self.groups[0].labels} labels with a known d'; recall at a score of "
            f"{self.threshold:.4f}, with {self.false_positives:.1f} false positives per frame",
            f"- a label that is found has a larger d' than a label that is missed with probability {self.auc:.3f}",
            f"- ideal observer: {self.places:.0f} places per frame; recall with as many false positives per frame",
            "",
            "## AP",
            "",
        ]
        rows = [
            [g.range, str(g.labels), *map(number, (g.ap50_paper, g.ideal_ap, g.share_of_ap))]
            for g in self.groups
            if g.by in ("all", "sun")
        ]
        lines += [*table(["Sun elevation, deg", "labels", "AP", "AP of the ideal observer", "share"], rows), ""]
        rows = [
            [f"{a.bound:g}", str(a.labels), *map(number, (a.ap50_paper, a.strict_ap, a.recall))] for a in self.above
        ]
        lines += [*table(["smallest d'", "labels", "AP", "strict AP", "recall"], rows), ""]
        titles = {
            "d_prime": "d'",
            "radius": "radius, px",
            "sun": "Sun elevation, deg",
            "depth_ratio": "depth / diameter",
        }
        for by, title in titles.items():
            rows = [
                [g.range, str(g.labels), *map(number, (g.d_prime, g.recall, g.ideal_recall, g.share))]
                for g in self.groups
                if g.by == by
            ]
            head = [title, "labels", "median d'", "recall", "recall of the ideal observer", "share"]
            lines += [f"## By {title}", "", *table(head, rows), ""]
        return "\n".join(lines)


def read_d_prime(path: Path, split: DetectSplit) -> Array:
    """The d' of the labels of a split, frame after frame (L,); NaN where the table has no row.

    Raises UserError if the table is damaged, has a key twice, or has no label of the split.
    """
    kinds = {"frame_id": "text", "crater_id": "integer", "d_prime": "number"}
    columns = read_table(path, DETECTABILITIES, kinds)  # type: ignore[arg-type]
    values = columns.finite("d_prime", -1e12, 1e12)
    keys = list(zip(columns.texts("frame_id").to_list(), columns.integers("crater_id").tolist(), strict=True))
    known = dict(zip(keys, values.tolist(), strict=True))
    if len(known) < len(keys):
        raise UserError(path, "frame_id, crater_id", "a pair that occurs twice", "one row for each label")
    found = [
        known.get((name, crater_id), np.nan)
        for name, labels in zip(split.frames.table["frame_id"].tolist(), split.labels, strict=True)
        for crater_id in (labels.crater_id if labels.crater_id is not None else np.full(len(labels.boxes), -1)).tolist()
    ]
    d_prime = np.array(found, np.float64)
    if not np.isfinite(d_prime).any():
        expected = "labels of the evaluated split, from `perilune-render detectability` over this dataset"
        raise UserError(path, "frame_id, crater_id", "no label of the split", expected)
    return d_prime


def by_detectability(
    split: DetectSplit, detections: list[Detections], d_prime: Array, threshold: float, match_iou: float
) -> ByDetectability:
    """Figures of the detections of a split by the d' (L,) of its labels, frame after frame.

    Only frames that have labels with a known d' count. All labels in the evaluated range of radii are selected,
    whatever the selection of the run.
    """
    facts, radius_px = facts_of(split.frames), split.radius_px
    overlaps = find_overlaps(detections, split.labels, facts.sizes_px, match_iou)
    labelled = np.concatenate([part.labelled for part in split.labels])
    radius = overlaps.label_radius_px
    in_range = labelled & within(radius, *radius_px, last=True)
    known = in_range & np.isfinite(d_prime)
    of_frame = np.zeros(len(facts), np.bool_)
    of_frame[overlaps.label_frame[known]] = True
    every = overlaps.match(match_iou, radius_px, in_range).of_frames(of_frame)
    hit = _found(overlaps, every, threshold)
    n_frames = int(of_frame.sum())
    false_positives = float(((every.outcome == FALSE) & (every.scores >= threshold)).sum() / n_frames)
    n_places = float(np.mean([places(width, height, radius_px) for width, height in facts.sizes_px[of_frame].tolist()]))
    t = observer_threshold(false_positives, n_places)
    sun = facts.sun_elevation_deg
    groups = [_group("all", (0.0, np.inf), known, d_prime, hit, t)]
    groups[0] = _with_ap(groups[0], every, d_prime[known], n_frames, n_places)
    for low, high in pairwise(SUN_BINS_DEG):
        in_bin = within(sun, low, high, high == SUN_BINS_DEG[-1])
        part = every.of_frames(in_bin)
        chosen = known & in_bin[overlaps.label_frame]
        if chosen.any():
            group = _group("sun", (low, high), chosen, d_prime, hit, t)
            groups.append(_with_ap(group, part, d_prime[chosen], int((in_bin & of_frame).sum()), n_places))
    columns = {
        "d_prime": (d_prime, D_PRIME_BINS),
        "radius": (radius, RADIUS_BINS_PX),
        "depth_ratio": (overlaps.label_depth_ratio, DEPTH_RATIO_BINS),
    }
    for by, (values, edges) in columns.items():
        for low, high in pairwise(edges):
            chosen = known & within(values, low, high, high == edges[-1])
            if chosen.any():
                groups.append(_group(by, (low, high), chosen, d_prime, hit, t))
    above = [
        _above(overlaps, of_frame, known & (d_prime >= bound), bound, (threshold, match_iou, radius_px))
        for bound in BOUNDS
    ]
    auc = separation(d_prime[known & hit], d_prime[known & ~hit])
    return ByDetectability(n_frames, threshold, false_positives, n_places, auc, groups, [a for a in above if a.labels])


def _found(overlaps: Overlaps, matches: Matches, threshold: float) -> Flags:
    """Whether each label (L,) is matched by a detection with at least this score."""
    hit = np.zeros(len(overlaps.label_frame), np.bool_)
    hit[matches.label[(matches.label >= 0) & (matches.scores >= threshold)]] = True
    return hit


def _group(by: str, limits: tuple[float, float], chosen: Flags, d_prime: Array, hit: Flags, t: float) -> Group:
    d = d_prime[chosen]
    return Group(by, *limits, len(d), float(np.median(d)), float(hit[chosen].mean()), ideal_recall(d, t))


def _with_ap(group: Group, matches: Matches, d_prime: Array, n_frames: int, n_places: float) -> Group:
    """The group with the AP of the detector, by the usual rule, and of the ideal observer."""
    ap = curve(matches).ap_paper()
    ideal = ideal_ap(d_prime, n_places * n_frames)
    return Group(
        group.by, group.low, group.high, group.labels, group.d_prime, group.recall, group.ideal_recall, ap, ideal
    )


def _above(
    overlaps: Overlaps,
    of_frame: Flags,
    selected: Flags,
    bound: float,
    criteria: tuple[float, float, tuple[float, float]],
) -> Above:
    threshold, match_iou, radius_px = criteria
    matches = overlaps.match(match_iou, radius_px, selected).of_frames(of_frame)
    hit = _found(overlaps, matches, threshold)
    recall = float(hit[selected].mean()) if selected.any() else float("nan")
    return Above(bound, int(selected.sum()), curve(matches).ap_paper(), curve(matches.strict()).ap_paper(), recall)


def places(width_px: float, height_px: float, radius_px: tuple[float, float]) -> float:
    """Number of places M of an image at which the ideal observer decides (module docstring)."""
    n_sizes = int(np.floor(2 * np.log2(max(radius_px[1] / radius_px[0], 1)))) + 1
    radii = radius_px[0] * np.sqrt(2.0) ** np.arange(n_sizes)
    return float((width_px * height_px / (np.pi * radii**2)).sum())


def observer_threshold(false_positives: float, n_places: float) -> float:
    """Threshold t of the ideal observer with this expected number of false positives per frame.

    Without a false positive, half a false positive per frame is assumed.
    """
    rate = np.clip(max(false_positives, 0.5) / n_places, 1e-12, 0.5)
    return float(-ndtri(rate))


def ideal_recall(d_prime: Array, t: float) -> float:
    """Expected recall of the ideal observer at threshold t."""
    return float(ndtr(d_prime - t).mean())


def ideal_ap(d_prime: Array, n_places: float) -> float:
    """AP of the ideal observer, from the expected numbers of hits and of false positives at all thresholds.

    `n_places` is the number of places without a crater, in all frames together.
    """
    t = np.linspace(max(float(d_prime.max()), 0) + 6, -6, _STEPS)
    hits = np.array([ndtr(d_prime - each).sum() for each in t])
    precision = hits / np.maximum(hits + n_places * ndtr(-t), 1e-300)
    recall = hits / len(d_prime)
    return float(np.sum(np.diff(recall, prepend=0.0) * precision))


def separation(found: Array, missed: Array) -> float:
    """Probability that a value of `found` exceeds a value of `missed`, equal values counted half; NaN without values.

    It is the area under the ROC curve.
    """
    if not len(found) or not len(missed):
        return float("nan")
    order = np.sort(missed)
    below = np.searchsorted(order, found, "left") + np.searchsorted(order, found, "right")
    return float(below.mean() / 2 / len(missed))


def write_by_detectability(folder: Path, result: ByDetectability, about: Sequence[str]) -> None:
    """Write DETECTABILITY_FILE."""
    write_markdown(folder / DETECTABILITY_FILE, result.markdown(about))
