"""Score of NASA's Crater Detection Challenge (November 2025 to January 2026) for detected ellipses.

The distance of two ellipses is the Gaussian angle: the angle between two normal distributions whose covariances have
the ellipses as contours. With centres y and matrices S (x^T S^-1 x = 1 on the rim),

    cos d = 4 sqrt(det S1 det S2) / det(S1 + S2) exp(-1/2 (y1 - y2)^T (S1 + S2)^-1 (y1 - y2)).

The challenge states this formula with the inverse matrices Y = S^-1; both forms are equal. A detection matches a label
if (d / s)^2 < 13.277 with s = 0.85 / sqrt(a b) 0.07 min(a, b) of the label, a rim error of 7 %. In addition, the
semi-minor axes differ by at most a factor of 1.5, and the centres by at most the smaller semi-minor axis in x and in y.
Labels are gone through in their order; each takes the free detection of least distance.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_MAX_CHI_SQUARED = 13.277
_RIM_ERROR = 0.07
_SCALE = 0.85
_MAX_RATIO = 1.5
_ENOUGH_MATCHES = 10


def gaussian_angles(first: Array, second: Array) -> Array:
    """Distances (N,), radians, of pairs of ellipses (N, 5): centre x, y, semi-axes a, b in pixels, direction of a."""
    xx, yy, xy = (one + other for one, other in zip(_matrices(first), _matrices(second), strict=True))
    determinant = xx * yy - xy**2
    x, y = (first[:, :2] - second[:, :2]).T
    exponent = (yy * x**2 - 2 * xy * x * y + xx * y**2) / determinant / 2
    areas = first[:, 2] * first[:, 3] * second[:, 2] * second[:, 3]
    return np.arccos(np.minimum(1.0, 4 * areas / determinant * np.exp(-exponent)))


def _matrices(ellipses: Array) -> tuple[Array, Array, Array]:
    """S_xx, S_yy and S_xy (N,) of ellipses (N, 5), square pixels."""
    _, _, a, b, theta = ellipses.T
    cos, sin = np.cos(theta), np.sin(theta)
    return (a * cos) ** 2 + (b * sin) ** 2, (a * sin) ** 2 + (b * cos) ** 2, (a**2 - b**2) * sin * cos


def matched_ellipses(detections: Array, labels: Array) -> tuple[NDArray[np.intp], Array]:
    """Detection that each label takes (T,), -1 if none, and its distance (T,), radians, NaN if none.

    `detections` (D, 5) and `labels` (T, 5) are ellipses with a >= b > 0.
    """
    smaller = np.minimum(labels[:, None, 3], detections[None, :, 3])
    near = np.maximum(labels[:, None, 3], detections[None, :, 3]) <= _MAX_RATIO * smaller
    for axis in range(2):
        near &= np.abs(labels[:, None, axis] - detections[None, :, axis]) <= smaller
    row, column = np.nonzero(near)
    angles = gaussian_angles(labels[row], detections[column])
    sigma = _SCALE / np.sqrt(labels[row, 2] * labels[row, 3]) * _RIM_ERROR * labels[row, 3]
    close = (angles / sigma) ** 2 < _MAX_CHI_SQUARED
    row, column, angles = row[close], column[close], angles[close]
    taken, angle, free = np.full(len(labels), -1, np.intp), np.full(len(labels), np.nan), np.ones(len(detections), bool)
    bounds = np.searchsorted(row, np.arange(len(labels) + 1))
    for label in np.unique(row):
        part = slice(bounds[label], bounds[label + 1])
        candidates = np.where(free[column[part]], angles[part], np.inf)
        best = int(candidates.argmin())
        if np.isfinite(candidates[best]):
            taken[label], angle[label] = column[part][best], candidates[best]
            free[taken[label]] = False
    return taken, angle


def image_score(detections: Array, labels: Array) -> float:
    """Score of one image, 0 to 1, from ellipses (D, 5) and (T, 5).

    The score is the sum of (1 - d / pi) over all matches, divided by the number of detections, times
    min(1, matches / min(10, labels)). It is 0 without detections. In an image without labels, it is 1 without
    detections, where truth and prediction are marked as empty, and 0 otherwise.
    """
    if not len(labels) or not len(detections):
        return float(len(labels) == len(detections))
    _, angles = matched_ellipses(detections, labels)
    matched = angles[np.isfinite(angles)]
    share = min(1.0, len(matched) / min(_ENOUGH_MATCHES, len(labels)))
    return float((1 - matched / np.pi).sum() / len(detections) * share)


def ellipse_score(detections: Sequence[Array], labels: Sequence[Array]) -> float:
    """Score of a set of images, 0 to 100: 100 times the mean of `image_score`; NaN without images."""
    scores = [image_score(*pair) for pair in zip(detections, labels, strict=True)]
    return 100 * float(np.mean(scores)) if scores else float("nan")
