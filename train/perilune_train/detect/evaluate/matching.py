"""Matching of detections to labels, over plain data.

Whoever has detections and labels of some images, rendered or real, judges them so::

    overlaps = find_overlaps(found, labels, sizes_px)          # list[Detections], list[FrameLabels], (N, 2)
    matches = overlaps.match(0.5, (2.0, 50.0))                 # at one IoU
    curve(matches).ap_paper()                                  # metrics.py

A detection is taken in order of score and finds the free wanted label of highest IoU, if that is at least the
IoU asked for. Two accounts are kept. The usual one leaves out what no one can judge: a detection that finds no wanted
label is not counted where it lies on an ignored crater (hardly visible, or just outside the labelled range), where
its radius sqrt(w h) / 2 is outside the labelled range, or where its centre is off the image. The strict one leaves
out nothing: all these are false. Between the two lies the account of the edge (`edge_range`). In the usual one nobody
pays for calling everything just under the least radius a crater, yet some of such boxes meet a label and count; in
this one a detection somewhat below the least radius is false too, unless it lies on a crater, wanted or not. In all of
them only wanted labels are to be found.

COCO (COCOeval without crowds) is the same but for two things. There an ignored label absorbs one detection, here any
number, since several detections on a crater that nobody can judge cannot be judged either; COCO comes to the same
figures where each ignored label is there once for every detection (a test does that). And COCO counts a detection
whose centre is off the image as false; the labels given to it know no such centres.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.data.split import FrameLabels
from perilune_train.detect.evaluate.boxes import iou_matrix

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]
FOUND, FALSE, IGNORED = 1, 0, -1
NO_LABEL, ON_IGNORED = -1, -2
EDGE = 0.75
"""The account of the edge judges radii down to this share of the least."""
COCO_IOUS = tuple(np.linspace(0.5, 0.95, 10).tolist())
"""The IoUs over which COCO averages, to the last bit."""


def edge_range(radius_px: tuple[float, float]) -> tuple[float, float]:
    """Range of radii, pixels, in which the account of the edge calls unmatched detections false."""
    return radius_px[0] * EDGE, radius_px[1]


@dataclass(frozen=True)
class Detections:
    """Detections of one frame, best first."""

    boxes: Array
    """x0, y0, x1, y1 in pixels (D, 4)."""
    scores: Array
    """(D,), in (0, 1)."""


@dataclass(frozen=True)
class Matches:
    """All detections of some frames, judged at one IoU."""

    scores: Array
    """(D,)."""
    outcome: NDArray[np.int8]
    """FOUND, FALSE or IGNORED (D,)."""
    label: Rows
    """The label that was found, a row of Overlaps; NO_LABEL or ON_IGNORED where none (D,)."""
    frame: Rows
    """Frame of each detection (D,)."""
    wanted_frame: Rows
    """Frame of each wanted label (L,)."""

    def strict(self) -> "Matches":
        """The same with every ignored detection counted as false."""
        return replace(self, outcome=np.where(self.outcome == IGNORED, FALSE, self.outcome).astype(np.int8))

    def of_frames(self, chosen: Flags) -> "Matches":
        """Those of the frames (N,) that are chosen."""
        own = chosen[self.frame]
        return Matches(
            self.scores[own],
            self.outcome[own],
            self.label[own],
            self.frame[own],
            self.wanted_frame[chosen[self.wanted_frame]],
        )


@dataclass(frozen=True)
class Overlaps:
    """Detections and labels of some frames end to end, and every pair of the two that may match."""

    boxes: Array
    """Of the detections, pixels, best first within a frame (D, 4)."""
    scores: Array
    """(D,)."""
    frame: Rows
    """Frame of each detection (D,)."""
    off_image: Flags
    """Whether a detection's centre is off the image (D,)."""
    label_boxes: Array
    """Pixels (L, 4)."""
    label_radius_px: Array
    """(L,)."""
    label_depth_ratio: Array
    """Depth over diameter, NaN where not known (L,)."""
    label_wanted: Flags
    """(L,)."""
    label_frame: Rows
    """Frame of each label (L,)."""
    pair_detection: Rows
    """Of each pair, its detection, rising (P,)."""
    pair_label: Rows
    """... its label; of one detection those of higher IoU come first, of equal ones the later (as COCO does) (P,)."""
    pair_iou: Array
    """... their IoU (P,)."""

    def radius_px(self) -> Array:
        """Radius sqrt(w h) / 2 of every detection, pixels (D,)."""
        return np.sqrt(np.prod(np.maximum(self.boxes[:, 2:] - self.boxes[:, :2], 0), axis=1)) / 2

    def match(self, match_iou: float, radius_px: tuple[float, float], wanted: Flags | None = None) -> Matches:
        """Judge every detection at one IoU, at least that of `find_overlaps`.

        `radius_px` is the range of radii outside which nothing can be judged; `wanted` (L,) takes the place of what
        the labels say.
        """
        wanted = self.label_wanted if wanted is None else wanted
        label = np.full(len(self.scores), NO_LABEL, np.intp)
        enough = self.pair_iou >= match_iou
        detection, other = self.pair_detection[enough], self.pair_label[enough]
        on_wanted = wanted[other]
        label[detection[~on_wanted]] = ON_IGNORED
        found, taken = {}, set()
        for one, its_label in zip(detection[on_wanted].tolist(), other[on_wanted].tolist(), strict=True):
            if one not in found and its_label not in taken:
                found[one] = its_label
                taken.add(its_label)
        label[list(found.keys())] = list(found.values())
        radius = self.radius_px()
        unjudged = (label == ON_IGNORED) | (radius < radius_px[0]) | (radius > radius_px[1]) | self.off_image
        outcome = np.where(label >= 0, FOUND, np.where(unjudged, IGNORED, FALSE)).astype(np.int8)
        return Matches(self.scores, outcome, label, self.frame, self.label_frame[wanted])


def find_overlaps(
    found: list[Detections], labels: list[FrameLabels], sizes_px: NDArray, least_iou: float = 0.5
) -> Overlaps:
    """All pairs with an IoU of at least `least_iou`, for frames of the widths and heights `sizes_px` (N, 2)."""
    boxes, scores, detections, others, values, n_found, n_labels = [], [], [], [], [], 0, 0
    for ours, truth in zip(found, labels, strict=True):
        order = np.argsort(-ours.scores, kind="stable")
        boxes.append(ours.boxes[order].reshape(-1, 4))
        scores.append(ours.scores[order])
        overlap = iou_matrix(boxes[-1], truth.boxes)
        row, column = np.nonzero(overlap >= least_iou)
        iou = overlap[row, column]
        sort = np.lexsort((-column, -iou, row))
        detections.append(row[sort] + n_found)
        others.append(column[sort] + n_labels)
        values.append(iou[sort])
        n_found, n_labels = n_found + len(ours.scores), n_labels + len(truth.boxes)
    box = np.concatenate(boxes) if boxes else np.empty((0, 4))
    frame = np.repeat(np.arange(len(found)), [len(part.scores) for part in found])
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
        _joined([part.wanted for part in labels]).astype(np.bool_),
        np.repeat(np.arange(len(labels)), [len(part.boxes) for part in labels]),
        _joined(detections).astype(np.intp),
        _joined(others).astype(np.intp),
        _joined(values),
    )


def match_split(
    found: list[Detections],
    labels: list[FrameLabels],
    image_size_px: tuple[int, int],
    match_iou: float,
    radius_px: tuple[float, float],
) -> Matches:
    """Judge the detections of frames of one size (width, height) at one IoU."""
    sizes = np.tile(image_size_px, (len(found), 1))
    return find_overlaps(found, labels, sizes, match_iou).match(match_iou, radius_px)


def _joined(parts: list) -> NDArray:
    return np.concatenate(parts) if parts else np.empty(0)


def _depth_ratio(labels: FrameLabels) -> Array:
    return np.full(len(labels.boxes), np.nan) if labels.depth_ratio is None else labels.depth_ratio
