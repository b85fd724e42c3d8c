"""Stretch deep pixels (more than 8 bits, or float) to 8 bits, and find values that mark missing data."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PERCENT = (0.05, 99.95)
"""The percentiles between which 99.9 % of the values lie."""
SAMPLE = 1_000_000
MAX_VALUE = 1e30
"""Larger values are not measurements: ISIS marks missing data with values near the end of float32's range."""
_FILL_SHARE = PERCENT[0] / 100
"""A fill value with a smaller share does not affect the stretch."""
_MAX_FILLS = 8


@dataclass(frozen=True)
class Stretch:
    """The mapping from the values of a picture to grey levels."""

    low: float
    """The value that becomes 0."""
    high: float
    """The value that becomes 255."""
    fills: tuple[float, ...] = ()
    """Values taken as missing data that the file does not declare."""
    fill_share: float = 0.0
    """Share of the pixels that have one of these values."""

    def grey(self, values: NDArray) -> NDArray[np.uint8]:
        """Map values to 0..255; pixels without data become 0."""
        known = np.isfinite(values)
        for fill in self.fills:
            known &= values != fill
        grey = (np.where(known, values, self.low) - self.low) * (255 / max(self.high - self.low, 1e-12))
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def stretch_of(sample: NDArray, find_fills: bool) -> Stretch:
    """The stretch of a sample of finite values.

    With `find_fills`, used if the file declares no missing data, a few values at an end of the range may count as
    missing data: many pixels must share them, and they must be far from all other values (-9999, 65535, the special
    pixels of ISIS). As measurements, such values would leave no range for the ground.
    """
    fills: list[float] = []
    rest = sample
    if find_fills:
        # Fill values at one end can hide fill values at the other, so check the first end twice.
        for sign in (1, -1, 1):
            end = _isolated_end(sign * rest, len(sample))
            fills += [sign * value for value in end]
            rest = rest[~np.isin(rest, fills)]
    low, high = np.percentile(rest, PERCENT) if len(rest) else (0.0, 1.0)
    share = 1 - len(rest) / max(len(sample), 1)
    return Stretch(float(low), float(high), tuple(fills), share)


def _isolated_end(values: NDArray, n_all: int) -> list[float]:
    """The smallest values, at most _MAX_FILLS, if they are fill values; otherwise [].

    Many pixels must share them, and their distance to all other values must exceed the range of the others.
    """
    distinct, counts = np.unique(values, return_counts=True)
    for n_fills in range(min(_MAX_FILLS, len(distinct) - 2), 0, -1):
        if counts[:n_fills].sum() < max(_FILL_SHARE * n_all, 2):
            break
        rest = values[values >= distinct[n_fills]]
        low, high = np.percentile(rest, PERCENT)
        # With a range of 0, a single other value would make all others missing.
        if high > low and float(distinct[n_fills]) - float(distinct[n_fills - 1]) > high - low:
            return [float(value) for value in distinct[:n_fills]]
    return []
