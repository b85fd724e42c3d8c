"""Matching of detections to labels, on plain arrays.

Evaluate detections against labels of rendered or real images with:

    overlaps = find_overlaps(detections, labels, sizes_px)     # list[Detections], list[FrameLabels], (N, 2)
    matches = overlaps.match(0.5, (2.0, 50.0))                 # at an IoU of 0.5, radii of 2 to 50 px
    curve(matches).ap_paper()                                  # metrics.py

Detections are matched in order of score. Each takes the unmatched selected label of highest IoU, if this IoU is at
least `match_iou`. Only selected labels count in recall. Three scoring rules differ in which unmatched detections are
false positives:

- Usual: an unmatched detection is ignored if it overlaps an ignored crater (not selected, or just outside the range
  of radii), if its radius sqrt(w h) / 2 is outside the range of radii, or if its centre is off the image. The labels
  cannot decide whether these detections are right. All other unmatched detections are false positives.
- Edge (`edge_range`): as usual, but the range of radii of detections starts at 0.75 of the smallest radius. By the
  usual rule a detector can report boxes just below the smallest radius everywhere: some of them match a label and
  count, and the others are ignored.
- Strict: every unmatched detection is a false positive.

A crowd (`FrameLabels.crowd`, COCO's `iscrowd`) is a region with any number of craters that are not labelled one by one.
As in COCO, the fraction of a detection inside the region replaces its IoU, and a matching detection is ignored.

There are two differences from COCO. In COCO an ignored label that is not a crowd takes only one detection; here it
takes any number, since detections on an ignored crater cannot be evaluated. COCO gives the same metrics if each ignored
label is repeated once for every detection (a test checks this). COCO counts a detection whose centre is off the image
as a false positive, because COCO's labels have no centres off the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.ellipses import ellipses_of
from perilune_train.detect.evaluate.boxes import coverage_matrix, iou_matrix

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]
FOUND, FALSE, IGNORED = 1, 0, -1
NO_LABEL, ON_IGNORED = -1, -2
EDGE = 0.75
"""In the edge scoring rule, false positives count down to this fraction of the smallest radius."""
COCO_IOUS = tuple(np.linspace(0.5, 0.95, 10).tolist())
"""The IoUs over which COCO averages, bit-identical to COCO's."""


def edge_range(radius_px: tuple[float, float]) -> tuple[float, float]:
    """Range of radii, pixels, in which unmatched detections are false positives by the edge scoring rule."""
    return radius_px[0] * EDGE, radius_px[1]


@dataclass(frozen=True, slots=True)
class Criteria:
    """Which detections and labels an evaluation counts."""

    threshold: float
    """Minimum score of the detections that count in precision, recall and F1. Choose it on other frames."""
    radius_px: tuple[float, float]
    """Range of the evaluated radii, pixels."""
    match_iou: float = 0.5
    """Minimum IoU of a match."""


@dataclass(frozen=True)
class Detections:
    """Detections of one frame, best first."""

    boxes: Array
    """x0, y0, x1, y1 in pixels (D, 4)."""
    scores: Array
    """Scores (D,), in (0, 1)."""
    shapes: Array | None = None
    """Correlation of the ellipse in each box (ellipses.py), and the standard deviations of the ellipse: of the centre's
    x and y, of the semi-major and of the semi-minor axis, pixels (D, 5). None if the detector predicts only boxes."""
    novelty: float | None = None
    """How unlike the training frames the frame is (novelty.py), above 1 unlike them all; None if unknown."""

    @property
    def ellipses(self) -> Array:
        """Centre x, y, semi-major and semi-minor axis in pixels, direction in radians, in [0, pi) (D, 5).

        Without shapes, the axis-aligned ellipses in the boxes.
        """
        return ellipses_of(self.boxes, np.zeros(len(self.boxes)) if self.shapes is None else self.shapes[:, 0])

    def take(self, chosen: NDArray) -> "Detections":
        """The detections with the given rows, or those for which a mask (D,) is True."""
        shapes = None if self.shapes is None else self.shapes[chosen]
        return replace(self, boxes=self.boxes[chosen], scores=self.scores[chosen], shapes=shapes)

    def moved(self, x_px: float, y_px: float) -> "Detections":
        """The detections with other coordinates: `x_px` and `y_px` are added."""
        return replace(self, boxes=self.boxes + np.array([x_px, y_px, x_px, y_px]))

    def divided(self, ratio_x: float, ratio_y: float) -> "Detections":
        """The detections in the coordinates of an image that was resized by these factors before detection.

        A correlation does not change; the standard deviation of a semi-axis changes as the semi-axis.
        """
        ratios = np.array([ratio_x, ratio_y])
        boxes = self.boxes / np.tile(ratios, 2)
        if self.shapes is None:
            return replace(self, boxes=boxes)
        axes, new_axes = (ellipses_of(part, self.shapes[:, 0])[:, 2:4] for part in (self.boxes, boxes))
        factors = np.divide(new_axes, axes, out=np.ones_like(axes), where=axes > 0)
        sigmas_px = self.shapes[:, 1:] * np.hstack([np.tile(1 / ratios, (len(boxes), 1)), factors])
        return replace(self, boxes=boxes, shapes=np.column_stack([self.shapes[:, 0], sigmas_px]))


def joined_detections(parts: Sequence[Detections]) -> Detections:
    """The detections of all parts (at least one) as one list, in the order of the parts, without novelty."""
    shapes = [part.shapes for part in parts if part.shapes is not None]
    return Detections(
        np.concatenate([part.boxes for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate(shapes) if shapes else None,
    )


@dataclass(frozen=True)
class Matches:
    """All detections of some frames, matched at one IoU."""

    scores: Array
    """Scores (D,)."""
    outcome: NDArray[np.int8]
    """Outcome of each detection: FOUND, FALSE or IGNORED (D,)."""
    label: Rows
    """Row in Overlaps of the matched label (D,). NO_LABEL: no match. ON_IGNORED: overlaps an ignored label only."""
    frame: Rows
    """Frame of each detection (D,)."""
    selected_frame: Rows
    """Frame of each selected label (L,)."""

    def strict(self) -> "Matches":
        """The matches with every ignored detection counted as a false positive."""
        return replace(self, outcome=np.where(self.outcome == IGNORED, FALSE, self.outcome).astype(np.int8))

    def of_frames(self, chosen: Flags) -> "Matches":
        """The matches in the frames for which `chosen` (N,) is True."""
        kept = chosen[self.frame]
        return Matches(
            self.scores[kept],
            self.outcome[kept],
            self.label[kept],
            self.frame[kept],
            self.selected_frame[chosen[self.selected_frame]],
        )


@dataclass(frozen=True)
class Overlaps:
    """Detections and labels of some frames, concatenated, and their pairs that may match."""

    boxes: Array
    """Boxes of the detections, pixels, best first within a frame (D, 4)."""
    scores: Array
    """Scores of the detections (D,)."""
    frame: Rows
    """Frame of each detection (D,)."""
    off_image: Flags
    """Whether a detection's centre is off the image (D,)."""
    label_boxes: Array
    """Boxes of the labels, pixels (L, 4)."""
    label_radius_px: Array
    """Radius of each label, pixels (L,)."""
    label_depth_ratio: Array
    """Depth over diameter of each label, NaN if unknown (L,)."""
    label_selected: Flags
    """Whether each label is selected (L,)."""
    label_frame: Rows
    """Frame of each label (L,)."""
    pair_detection: Rows
    """Detection of each pair, ascending (P,)."""
    pair_label: Rows
    """Label of each pair (P,). The labels of one detection are sorted by decreasing IoU; for equal IoU the later label
    is first, as in COCO."""
    pair_iou: Array
    """IoU of each pair; for a crowd, the fraction of the detection inside the crowd (P,)."""
    ellipses: Array
    """Ellipses of the detections (D, 5), as in `Detections.ellipses`."""
    sigmas_px: Array
    """Standard deviations of the ellipses' centre x, y and semi-axes, pixels (D, 4); NaN if they are not predicted."""
    label_ellipses: Array
    """Ellipses of the labels (L, 5), as in `FrameLabels.ellipses`."""

    def radius_px(self) -> Array:
        """Radius sqrt(w h) / 2 of every detection, pixels (D,)."""
        return np.sqrt(np.prod(np.maximum(self.boxes[:, 2:] - self.boxes[:, :2], 0), axis=1)) / 2

    def match(self, match_iou: float, radius_px: tuple[float, float], selected: Flags | None = None) -> Matches:
        """Match every detection at one IoU, which must be at least the `min_iou` of `find_overlaps`.

        `radius_px` is the evaluated range of radii; unmatched detections outside the range are ignored. `selected` (L,)
        replaces `label_selected`.
        """
        selected = self.label_selected if selected is None else selected
        label = np.full(len(self.scores), NO_LABEL, np.intp)
        enough = self.pair_iou >= match_iou
        detection, other = self.pair_detection[enough], self.pair_label[enough]
        on_selected = selected[other]
        label[detection[~on_selected]] = ON_IGNORED
        label_of, taken = {}, set()
        for candidate, its_label in zip(detection[on_selected].tolist(), other[on_selected].tolist(), strict=True):
            if candidate not in label_of and its_label not in taken:
                label_of[candidate] = its_label
                taken.add(its_label)
        label[list(label_of.keys())] = list(label_of.values())
        radius = self.radius_px()
        ignored = (label == ON_IGNORED) | (radius < radius_px[0]) | (radius > radius_px[1]) | self.off_image
        outcome = np.where(label >= 0, FOUND, np.where(ignored, IGNORED, FALSE)).astype(np.int8)
        return Matches(self.scores, outcome, label, self.frame, self.label_frame[selected])


def find_overlaps(
    detections: list[Detections], labels: Sequence[FrameLabels], sizes_px: NDArray, min_iou: float = 0.5
) -> Overlaps:
    """Overlaps of the detections and labels of N frames, with all pairs of at least `min_iou`.

    `sizes_px` (N, 2) are the widths and heights of the frames.
    """
    boxes, scores, pair_detections, pair_labels, pair_ious, n_found, n_labels = [], [], [], [], [], 0, 0
    ellipses, sigmas_px = [], []
    for found, truth in zip(detections, labels, strict=True):
        ours = found.take(np.argsort(-found.scores, kind="stable"))
        boxes.append(ours.boxes.reshape(-1, 4))
        scores.append(ours.scores)
        ellipses.append(replace(ours, boxes=boxes[-1]).ellipses)
        sigmas_px.append(np.full((len(ours.scores), 4), np.nan) if ours.shapes is None else ours.shapes[:, 1:])
        overlap = iou_matrix(boxes[-1], truth.boxes)
        if truth.crowd is not None:
            overlap[:, truth.crowd] = coverage_matrix(boxes[-1], truth.boxes[truth.crowd])
        row, column = np.nonzero(overlap >= min_iou)
        iou = overlap[row, column]
        sort = np.lexsort((-column, -iou, row))
        pair_detections.append(row[sort] + n_found)
        pair_labels.append(column[sort] + n_labels)
        pair_ious.append(iou[sort])
        n_found, n_labels = n_found + len(ours.scores), n_labels + len(truth.boxes)
    box = np.concatenate(boxes) if boxes else np.empty((0, 4))
    frame = np.repeat(np.arange(len(detections)), [len(part.scores) for part in detections])
    centre = (box[:, :2] + box[:, 2:]) / 2
    size = np.asarray(sizes_px).reshape(-1, 2)[frame]
    return Overlaps(
        box,
        _joined(scores),
        frame,
        ((centre < 0) | (centre >= size)).any(axis=1),
        np.concatenate([part.boxes.reshape(-1, 4) for part in labels]) if labels else np.empty((0, 4)),
        _joined([part.radius_px for part in labels]),
        _joined([_depth_ratio(part) for part in labels]),
        _joined([part.selected for part in labels]).astype(np.bool_),
        np.repeat(np.arange(len(labels)), [len(part.boxes) for part in labels]),
        _joined(pair_detections).astype(np.intp),
        _joined(pair_labels).astype(np.intp),
        _joined(pair_ious),
        np.concatenate(ellipses) if ellipses else np.empty((0, 5)),
        np.concatenate(sigmas_px) if sigmas_px else np.empty((0, 4)),
        np.concatenate([part.ellipses.reshape(-1, 5) for part in labels]) if labels else np.empty((0, 5)),
    )


def match_split(
    detections: list[Detections],
    labels: Sequence[FrameLabels],
    image_size_px: tuple[int, int],
    match_iou: float,
    radius_px: tuple[float, float],
) -> Matches:
    """Match the detections of frames of one size (width, height) at one IoU."""
    sizes = np.tile(image_size_px, (len(detections), 1))
    return find_overlaps(detections, labels, sizes, match_iou).match(match_iou, radius_px)


def joined(parts: Sequence[Matches]) -> Matches:
    """Join the matches of several processes, each of which had every n-th frame; sorted by frame.

    In the result, `label` is no longer the row of the label: several labels have equal numbers.
    """

    def numbered(name: str) -> NDArray:
        return _joined([getattr(part, name) * len(parts) + i for i, part in enumerate(parts)]).astype(np.intp)

    frame = numbered("frame")
    order = np.argsort(frame, kind="stable")
    scores, outcome, label = (
        _joined([getattr(part, name) for part in parts])[order] for name in ("scores", "outcome", "label")
    )
    return Matches(scores, outcome, label, frame[order], np.sort(numbered("selected_frame")))


def _joined(parts: list) -> NDArray:
    return np.concatenate(parts) if parts else np.empty(0)


def _depth_ratio(labels: FrameLabels) -> Array:
    return np.full(len(labels.boxes), np.nan) if labels.depth_ratio is None else labels.depth_ratio
