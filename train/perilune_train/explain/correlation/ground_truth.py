"""The paper's ground-truth mask G of a frame (section "Explainability analysis")."""

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array


def ground_truth_mask(
    width_px: int, height_px: int, centres_px: ArrayLike, radii_px: ArrayLike, ring_factors: tuple[float, ...]
) -> Array:
    """The paper's mask G (height, width): 0 in craters, 0.2, 0.4, 0.6, 0.8 in rings around them, 1 elsewhere.

    Takes centres (N, 2) and radii (N,) in pixels; the rings end at ring_factors times the radius (equation
    "crater_width"). Where craters overlap, the smallest value is used; the paper does not define this case. The paper's
    text calls the craters white and the background black, which contradicts its numbers; this code uses the numbers.
    """
    mask = np.ones((height_px, width_px))
    levels = np.arange(len(ring_factors) + 1) / (len(ring_factors) + 1)
    for (x, y), radius in zip(np.asarray(centres_px, np.float64).reshape(-1, 2), np.asarray(radii_px), strict=True):
        reach = radius * ring_factors[-1]
        left, right = max(int(x - reach), 0), min(int(x + reach) + 1, width_px)
        top, bottom = max(int(y - reach), 0), min(int(y + reach) + 1, height_px)
        if left >= right or top >= bottom:
            continue
        u, v = np.meshgrid(np.arange(left, right) + 0.5, np.arange(top, bottom) + 0.5)
        distance = np.hypot(u - x, v - y) / radius
        value = np.append(levels, 1.0)[np.searchsorted([1.0, *ring_factors], distance)]
        part = mask[top:bottom, left:right]
        np.minimum(part, value, out=part)
    return mask
