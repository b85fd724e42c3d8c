"""Overlap and suppression of boxes in NumPy. A box is x0, y0, x1, y1 in pixels, x1 >= x0, y1 >= y0."""

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def iou_matrix(first: ArrayLike, second: ArrayLike) -> Array:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4); 0 where both are empty."""
    a, b = (np.asarray(boxes, np.float64).reshape(-1, 4).T for boxes in (first, second))
    # One matrix per side, because a last axis of length two takes twice as long.
    width, height = (
        np.maximum(np.minimum(a[i + 2, :, None], b[i + 2]) - np.maximum(a[i, :, None], b[i]), 0) for i in (0, 1)
    )
    overlap = width * height
    area_a, area_b = ((c[2] - c[0]) * (c[3] - c[1]) for c in (a, b))
    union = area_a[:, None] + area_b - overlap
    return np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)


def suppress(boxes: ArrayLike, scores: ArrayLike, threshold_iou: float, max_count: int) -> NDArray[np.intp]:
    """Non-maximum suppression (OpenCV's): indices of the kept boxes, best first, at most `max_count`.

    A box is removed if its IoU with a kept box of a higher score exceeds `threshold_iou`; equal scores keep their
    order. No limit on candidates cuts the result short: several hundred craters with a dozen predictors each would
    exceed any usual one.
    """
    boxes, scores = np.asarray(boxes, np.float64).reshape(-1, 4), np.asarray(scores, np.float64)
    if not len(boxes):
        return np.empty(0, np.intp)
    corner_and_size = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    # OpenCV compares scores as float32. Its time grows with candidates times kept boxes, and the best `max_count` kept
    # boxes depend on no lower score, so suppress only as many of the best candidates as give that number.
    order = np.argsort(-scores.astype(np.float32), kind="stable")
    considered = max(max_count, 1)
    while True:
        considered *= 2
        best = order[:considered]
        kept = cv2.dnn.NMSBoxes(corner_and_size[best], scores[best], 0.0, threshold_iou)
        if len(kept) >= max_count or considered >= len(order):
            return best[np.asarray(kept, np.intp).reshape(-1)[:max_count]]
