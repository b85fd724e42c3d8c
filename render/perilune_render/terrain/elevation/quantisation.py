"""Quantised heights: find the step, and smooth the terraces within each height's rounding interval."""

import numpy as np
from scipy import ndimage

from perilune_shared.geometry.frames import Array

_MIN_SLOPE = 1e-3
"""Slope (step divided by pixel size) up to which terraces are not visible."""
_MIN_REPEATS = 4
"""Heights count as quantised only if each distinct value occurs in at least this number of pixels, on average."""
_WIDEST_TERRACE_PX = 64
_GENTLE = 3.5
"""Range of heights over 3 x 3 pixels, in steps, below which roughness is attributed to rounding, not to the ground."""


def step_of(height_m: Array, pixel_m: float) -> float:
    """Quantisation step, metres, of finite heights (N,); 0 if no step makes visible terraces.

    Heights are quantised if values repeat and all differences from the lowest height are multiples of the step, to
    within a twentieth of the step.
    """
    distinct = np.unique(height_m)
    if len(distinct) < 3 or len(height_m) < _MIN_REPEATS * len(distinct):
        return 0.0
    offset = distinct - distinct[0]
    gaps = np.diff(distinct)
    rounding = float(4 * np.finfo(np.float32).eps * np.abs(distinct).max())
    smallest = float(np.min(gaps[gaps > rounding])) if (gaps > rounding).any() else np.inf
    step = float(np.median(gaps[(gaps > rounding) & (gaps <= 1.5 * smallest)])) if np.isfinite(smallest) else 0.0
    if step <= max(_MIN_SLOPE * pixel_m, 8 * rounding):
        return 0.0
    # A longer range of multiples gives a more accurate step.
    for count in np.geomspace(10, max(offset[-1] / step, 10), 8):
        near = offset[offset <= (count + 0.5) * step]
        multiple = np.rint(near / step)
        if multiple.any():
            step = float(multiple @ near / (multiple @ multiple))
    off = np.abs(offset - step * np.rint(offset / step))
    return step if off.max() <= 0.05 * step + 2 * rounding else 0.0


def smoothed(height_m: Array, step_m: float) -> Array:
    """Heights (rows, columns) without terraces, each within half a step of the given height.

    Each terrace is smoothed over about its own width, wide ones first, and clipped to the rounding interval. Steep
    ground is not changed.
    """
    edge = np.zeros(height_m.shape, bool)
    for view, steps in ((edge, np.diff(height_m, axis=0) != 0), (edge.T, (np.diff(height_m, axis=1) != 0).T)):
        view[1:] |= steps
        view[:-1] |= steps
    depth_px = ndimage.distance_transform_edt(~edge) if edge.any() else np.full(height_m.shape, np.inf)
    result, size = height_m, _WIDEST_TERRACE_PX
    while size >= 1:
        wide = ndimage.uniform_filter((depth_px >= size).astype(np.float32), 2 * size + 1) > 1e-6
        if size == 1:
            wide |= ndimage.maximum_filter(height_m, 3) - ndimage.minimum_filter(height_m, 3) < _GENTLE * step_m
        if wide.any():
            blurred = np.clip(_blurred(result, size), height_m - step_m / 2, height_m + step_m / 2)
            result = np.where(wide, blurred, result)
        size //= 2
    return result


def _blurred(height_m: Array, half_px: int) -> Array:
    """Three successive box filters, which approximate a Gaussian; the slope at the edge is kept."""
    margin = min(3 * half_px, min(height_m.shape) - 1)
    padded = np.pad(height_m, margin, mode="reflect", reflect_type="odd")
    for _ in range(3):
        padded = ndimage.uniform_filter(padded, 2 * half_px + 1, mode="nearest")
    return padded[margin:-margin, margin:-margin]
