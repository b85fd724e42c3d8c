"""Convert boxes, shapes and sizes of label files, and check them."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels."""
StatedSize = tuple[int | None, int | None]
"""Width and height in pixels; None if not stated."""
MAX_PX = 1e6
"""Largest absolute value of a coordinate, width or height, pixels."""


def box_of(values: Any, path: Path, field: str, may_be_empty: bool = True) -> Box:
    """A box from left, top, width and height. Raises UserError if `values` are not such numbers."""
    try:
        x, y, w, h = (float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        raise UserError(path, field, values, "four numbers: left, top, width, height") from None
    shorter = min(w, h)
    if not all(math.isfinite(v) and abs(v) <= MAX_PX for v in (x, y, w, h)) or not (
        shorter > 0 or (may_be_empty and shorter == 0)
    ):
        minimum = "of at least 0" if may_be_empty else "above 0"
        raise UserError(path, field, values, f"a width and height {minimum}, and no number beyond {MAX_PX:.0f} px")
    return x, y, x + w, y + h


def around(points: Iterable[Any], path: Path, field: str) -> Box:
    """The box around points (x, y). Raises UserError without points or on invalid numbers."""
    try:
        pairs = [(float(x), float(y)) for x, y in points]
        xs, ys = zip(*pairs, strict=True)
    except (TypeError, ValueError, OverflowError):
        raise UserError(path, field, "no points", "pairs of numbers, x and y in pixels") from None
    if not all(math.isfinite(v) and abs(v) <= MAX_PX for v in (*xs, *ys)):
        raise UserError(path, field, "a number that is not finite or too large", f"at most {MAX_PX:.0f} px")
    return min(xs), min(ys), max(xs), max(ys)


def around_ellipse(centre: tuple[float, float], half: tuple[float, float], turn_deg: float = 0.0) -> Box:
    """The box around an ellipse with semi-axes `half`, rotated about its centre by `turn_deg`."""
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    x, y = math.hypot(half[0] * cos, half[1] * sin), math.hypot(half[0] * sin, half[1] * cos)
    return centre[0] - x, centre[1] - y, centre[0] + x, centre[1] + y


def around_turned(box: Box, turn_deg: float) -> Box:
    """The upright box around a box that is rotated about its centre."""
    cos, sin = abs(math.cos(math.radians(turn_deg))), abs(math.sin(math.radians(turn_deg)))
    x, y, w, h = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2, box[2] - box[0], box[3] - box[1]
    across, down = (w * cos + h * sin) / 2, (w * sin + h * cos) / 2
    return x - across, y - down, x + across, y + down


def size_of(width: Any, height: Any, path: Path, field: str) -> StatedSize:
    """Width and height that a file states as numbers or text; None if it states null, 0 or nothing."""
    return _whole(width, path, field), _whole(height, path, field)


def _whole(value: Any, path: Path, field: str) -> int | None:
    if value in (None, "", 0, "0"):
        return None
    try:
        if isinstance(value, bool) or float(value) % 1:
            raise ValueError
        return int(float(value))
    except (TypeError, ValueError, OverflowError):
        raise UserError(path, field, value, "whole pixels") from None
