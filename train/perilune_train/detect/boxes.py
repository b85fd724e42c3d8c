"""Boxes in NumPy: overlap and suppression. A box is x0, y0, x1, y1 in pixels, x1 >= x0, y1 >= y0."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_CANDIDATES = 4
"""Boxes looked at for each that may be kept."""


def iou_matrix(first: ArrayLike, second: ArrayLike) -> Array:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4); 0 where both are empty."""
    a = np.asarray(first, np.float64).reshape(-1, 1, 4)
    b = np.asarray(second, np.float64).reshape(1, -1, 4)
    size = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0, None)
    overlap = size[..., 0] * size[..., 1]
    area_a = np.prod(a[..., 2:] - a[..., :2], axis=-1)
    area_b = np.prod(b[..., 2:] - b[..., :2], axis=-1)
    union = area_a + area_b - overlap
    return np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)


def suppress(boxes: ArrayLike, scores: ArrayLike, threshold_iou: float, most: int) -> NDArray[np.intp]:
    """Non-maximum suppression: indices of the kept boxes, best first, at most `most`.

    A box goes where it overlaps a kept better one by more than `threshold_iou`; equal scores keep their order.
    Only the best 4 * most boxes are looked at: an untrained network offers all of its 16,128 predictors.
    """
    boxes, scores = np.asarray(boxes, np.float64), np.asarray(scores)
    left = np.argsort(-scores, kind="stable")[: _CANDIDATES * most]
    kept: list[np.intp] = []
    while len(left) and len(kept) < most:
        kept.append(left[0])
        overlap = iou_matrix(boxes[left[0]], boxes[left[1:]])[0]
        left = left[1:][overlap <= threshold_iou]
    return np.array(kept, np.intp)
