"""Ellipses in boxes: conversion between an ellipse and its bounding box with a correlation, in NumPy.

An ellipse is the set of points x with (x - c)^T S^-1 (x - c) = 1, where c is the centre and S a symmetric matrix. The
half sides of its bounding box are sqrt(S_xx) and sqrt(S_yy). So the box and the correlation S_xy / sqrt(S_xx S_yy)
determine the ellipse. Unlike an angle, the correlation is continuous: it is 0 for a circle and changes smoothly when an
ellipse turns. It does not change when an image is stretched along x or y.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def correlations_of(ellipses: Array) -> Array:
    """Correlations (N,) of ellipses (N, 5): centre x, y, semi-axes a, b in pixels, direction of a in radians.

    0 for ellipses without area.
    """
    a, b, theta = ellipses[:, 2:].T
    cos, sin = np.cos(theta), np.sin(theta)
    product = np.hypot(a * cos, b * sin) * np.hypot(a * sin, b * cos)
    return np.divide((a**2 - b**2) * sin * cos, product, out=np.zeros_like(a), where=product > 0)


def ellipses_of(boxes: Array, correlations: Array) -> Array:
    """Ellipses (N, 5) with the bounding boxes (N, 4), pixels, and correlations (N,).

    The columns are the centre x and y, the semi-major and the semi-minor axis, pixels, and the direction of the
    semi-major axis from x towards y, radians, in [0, pi).
    """
    half = np.maximum(boxes[:, 2:] - boxes[:, :2], 0) / 2
    sxx, syy = half[:, 0] ** 2, half[:, 1] ** 2
    sxy = correlations * half[:, 0] * half[:, 1]
    major = np.sqrt((sxx + syy) / 2 + np.hypot((sxx - syy) / 2, sxy))
    # Product of the semi-axes; the difference of the eigenvalues would lose digits.
    area = half[:, 0] * half[:, 1] * np.sqrt(np.maximum(1 - correlations**2, 0))
    minor = np.divide(area, major, out=np.zeros_like(area), where=major > 0)
    theta = np.mod(np.arctan2(2 * sxy, sxx - syy) / 2, np.pi)
    # The remainder of a tiny negative angle is rounded to pi.
    theta = np.where(theta >= np.pi, 0.0, theta)
    return np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, major, minor, theta])
