"""Anchors by k-means over the sizes of the labels.

The distance is 1 - IoU (Redmon & Farhadi 2017, arXiv 1612.08242).
"""

import numpy as np
from numpy.typing import NDArray

from perilune_train.detect.evaluate.boxes import iou_matrix

Array = NDArray[np.float64]
_SAMPLE = 20_000
_STEPS = 24
_ROUNDS = 100


def size_iou(sizes: Array, anchors: Array) -> Array:
    """IoU (N, K) of boxes of widths and heights (N, 2) with anchors (K, 2), all centred on one point."""
    return iou_matrix(*(np.concatenate([-sides, sides], axis=1) / 2 for sides in (sizes, anchors)))


def kmeans_anchors(sizes_px: Array, count: int, rng: np.random.Generator, plain: bool = False) -> Array:
    """Anchors (count, 2) for label sizes (N, 2) > 0: widths and heights in pixels, sorted by area.

    Clusters 20,000 sizes drawn with `rng`, weighted by the inverse square root of the frequency of each size. Without
    the weights (`plain`), most anchors fit small craters, because craters of 40 px are a hundred times rarer than
    craters of 5 px. The initial anchors are squares with evenly spaced logarithms of the area. If a cluster becomes
    empty, its anchor is replaced by the size that all anchors fit worst.
    """
    sizes = np.asarray(sizes_px, np.float64)
    if len(sizes) == 0:
        raise ValueError("no sizes to cluster")
    log_area = np.log(sizes.prod(axis=1))
    step = np.digitize(log_area, np.linspace(log_area.min(), log_area.max(), _STEPS + 1)[1:-1])
    weight = np.bincount(step, minlength=_STEPS)[step] ** (0.0 if plain else -0.5)
    sizes = sizes[rng.choice(len(sizes), _SAMPLE, p=weight / weight.sum())]
    log_area = np.log(sizes.prod(axis=1))
    side = np.exp(np.linspace(log_area.min(), log_area.max(), count) / 2)
    anchors = np.stack([side, side], axis=1)
    for _ in range(_ROUNDS):
        overlap = size_iou(sizes, anchors)
        nearest = overlap.argmax(axis=1)
        worst = sizes[overlap.max(axis=1).argmin()]
        moved = np.array(
            [np.median(sizes[nearest == k], axis=0) if (nearest == k).any() else worst for k in range(count)]
        )
        if np.allclose(moved, anchors):
            break
        anchors = moved
    return anchors[np.argsort(anchors.prod(axis=1), kind="stable")]


def best_possible_recall(sizes_px: Array, anchors: Array, ratio: float) -> float:
    """Fraction of sizes (N, 2) that have an anchor within the factor `ratio` in width and in height."""
    quotient = np.asarray(sizes_px)[:, None] / anchors[None]
    return float((np.maximum(quotient, 1 / quotient).max(axis=2) < ratio).any(axis=1).mean())


def mean_best_iou(sizes_px: Array, anchors: Array) -> float:
    """Mean over sizes (N, 2) of the IoU with the best anchor, both centred on one point."""
    return float(size_iou(np.asarray(sizes_px, np.float64), anchors).max(axis=1).mean())
