"""Overlap and suppression of boxes in NumPy. A box is x0, y0, x1, y1 in pixels, x1 >= x0, y1 >= y0."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perilune_train.compiled import compiled

Array = NDArray[np.float64]


def iou_matrix(first: ArrayLike, second: ArrayLike) -> Array:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4); 0 where both are empty."""
    overlap, area = _intersections(first, second)
    other = np.asarray(second, np.float64).reshape(-1, 4)
    union = area[:, None] + (other[:, 2] - other[:, 0]) * (other[:, 3] - other[:, 1]) - overlap
    return np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)


def coverage_matrix(first: ArrayLike, second: ArrayLike) -> Array:
    """Fraction (N, M) of the area of each box (N, 4) inside each region (M, 4); 0 for empty boxes."""
    overlap, area = _intersections(first, second)
    return np.divide(overlap, area[:, None], out=np.zeros_like(overlap), where=area[:, None] > 0)


def _intersections(first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    """Areas (N, M) of the intersections of boxes (N, 4) and (M, 4), and areas (N,) of the first boxes."""
    a, b = (np.asarray(boxes, np.float64).reshape(-1, 4).T for boxes in (first, second))
    # Separate matrices for width and height: one array with a last axis of length two would take twice the time.
    width, height = (
        np.maximum(np.minimum(a[i + 2, :, None], b[i + 2]) - np.maximum(a[i, :, None], b[i]), 0) for i in (0, 1)
    )
    return width * height, (a[2] - a[0]) * (a[3] - a[1])


def suppress(boxes: ArrayLike, scores: ArrayLike, threshold_iou: float, max_count: int) -> NDArray[np.intp]:
    """Non-maximum suppression: indices of the kept boxes, best first, at most `max_count`.

    A box is removed if its IoU with a kept box of a higher score exceeds `threshold_iou`; equal scores keep their
    order. Scores must be above 0. The result equals OpenCV's (`cv2.dnn.NMSBoxes`), which compares scores and overlaps
    as float32. The number of candidates is not limited: several hundred craters with a dozen predictors each would
    exceed any usual limit.
    """
    boxes, scores = np.asarray(boxes, np.float64).reshape(-1, 4), np.asarray(scores, np.float64)
    if not len(boxes):
        return np.empty(0, np.intp)
    order = np.argsort(-scores.astype(np.float32), kind="stable")
    corner_and_size = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)[order]
    return order[_kept(corner_and_size, np.float32(threshold_iou), max_count)]


@compiled
def _kept(boxes: Array, threshold_iou: np.float32, max_count: int) -> NDArray[np.intp]:
    """Indices of the boxes that suppression keeps, at most `max_count`.

    The boxes (N, 4) are x, y, width, height, best first. Each cell of a grid lists the kept boxes that touch it, so
    that a box is compared only with nearby boxes. Two boxes that overlap touch a common cell; cells at the edge of the
    grid include everything beyond the grid. A box that touches more than `max_cells` cells, or has no area, goes to a
    separate list and is compared with all boxes.
    """
    side, max_cells = 32, 64
    n, low, high = len(boxes), np.empty(2), np.empty(2)
    for axis in range(2):
        middle = boxes[:, axis] + boxes[:, 2 + axis] / 2
        low[axis], high[axis] = middle.min(), middle.max()
    cell = np.maximum((high - low) / side, 1e-6)
    heads = np.full((side, side), -1)
    # Each cell has a linked list that starts at its entry in `heads`. An entry is the index of a kept box, and the
    # index of the next entry (-1 at the end).
    entries, n_entries = np.empty((4 * n + max_cells, 2), np.int64), 0
    kept, n_kept = np.empty(min(n, max_count), np.int64), 0
    large, n_large = np.empty(n, np.int64), 0
    first, last = np.empty(2, np.int64), np.empty(2, np.int64)
    for k in range(n):
        if n_kept >= max_count:
            break
        for axis in range(2):
            start, stop = boxes[k, axis], boxes[k, axis] + boxes[k, 2 + axis]
            first[axis] = min(max((start - low[axis]) / cell[axis], 0.0), side - 1.0)
            last[axis] = min(max((stop - low[axis]) / cell[axis], 0.0), side - 1.0)
        touched = (last[0] - first[0] + 1) * (last[1] - first[1] + 1)
        # OpenCV gives two boxes without area an overlap of 1, wherever they are.
        everywhere = touched > max_cells or boxes[k, 2] * boxes[k, 3] <= 0
        removed = False
        if everywhere:
            for i in range(n_kept):
                if _overlap(boxes[kept[i]], boxes[k]) > threshold_iou:
                    removed = True
                    break
        else:
            for i in range(n_large):
                if _overlap(boxes[large[i]], boxes[k]) > threshold_iou:
                    removed = True
                    break
            for column in range(first[0], last[0] + 1):
                for row in range(first[1], last[1] + 1):
                    entry = heads[row, column]
                    while entry >= 0 and not removed:
                        removed = _overlap(boxes[entries[entry, 0]], boxes[k]) > threshold_iou
                        entry = entries[entry, 1]
        if removed:
            continue
        kept[n_kept] = k
        n_kept += 1
        if everywhere:
            large[n_large] = k
            n_large += 1
            continue
        if n_entries + touched > len(entries):
            longer = np.empty((2 * len(entries), 2), np.int64)
            longer[:n_entries] = entries[:n_entries]
            entries = longer
        for column in range(first[0], last[0] + 1):
            for row in range(first[1], last[1] + 1):
                entries[n_entries, 0], entries[n_entries, 1] = k, heads[row, column]
                heads[row, column] = n_entries
                n_entries += 1
    return kept[:n_kept]


@compiled
def _overlap(first: Array, second: Array) -> np.float32:
    """IoU of two boxes (4,) x, y, width and height, rounded as OpenCV does; 1 for two boxes without area."""
    areas = first[2] * first[3] + second[2] * second[3]
    if areas <= 2.220446049250313e-16:
        return np.float32(1.0)
    width = min(first[0] + first[2], second[0] + second[2]) - max(first[0], second[0])
    height = min(first[1] + first[3], second[1] + second[3]) - max(first[1], second[1])
    common = max(width, 0.0) * max(height, 0.0)
    return np.float32(1.0) - np.float32(1.0 - common / (areas - common))
