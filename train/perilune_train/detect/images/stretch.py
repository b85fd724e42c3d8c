"""Stretch deep pixels (more than 8 bits, or float) to 8 bits, and find values that mark missing data."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PERCENT = (0.05, 99.95)
"""Percentiles of the values that become 0 and 255; 99.9 % of the values lie between them."""
SAMPLE = 1_000_000
"""Approximate number of pixels from which a stretch is computed."""
MAX_VALUE = 1e30
"""Larger values are not measurements: ISIS marks missing data with values near the end of float32's range."""
_MIN_FILL_FRACTION = PERCENT[0] / 100
"""Minimum fraction of the pixels with fill values. Fewer fill values do not affect the stretch."""
_MAX_FILLS = 8


@dataclass(frozen=True)
class Stretch:
    """Linear mapping of the values of a picture to grey levels."""

    low: float
    """The value that becomes 0."""
    high: float
    """The value that becomes 255."""
    fills: tuple[float, ...] = ()
    """Values that are taken as missing data although the file does not declare them."""
    fill_share: float = 0.0
    """Fraction of the pixels that have one of these values."""

    def grey(self, values: NDArray) -> NDArray[np.uint8]:
        """Map values to 0..255; pixels without data become 0."""
        known = np.isfinite(values)
        for fill in self.fills:
            known &= values != fill
        grey = (np.where(known, values, self.low) - self.low) * (255 / max(self.high - self.low, 1e-12))
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def stretch_of(sample: NDArray, find_fills: bool) -> Stretch:
    """The stretch for a picture, from a sample of its finite values.

    Set `find_fills` if the file declares no missing data. Then a few distinct values at an end of the range (-9999,
    65535, the special pixels of ISIS) are taken as missing data, if many pixels have them and they are far from all
    other values. As measurements, these values would leave no grey levels for the ground.
    """
    fills: list[float] = []
    rest = sample
    if find_fills:
        # Fill values at one end can hide fill values at the other end, so check the first end twice.
        for sign in (1, -1, 1):
            end = _isolated_end(sign * rest, len(sample))
            fills += [sign * value for value in end]
            rest = rest[~np.isin(rest, fills)]
    low, high = np.percentile(rest, PERCENT) if len(rest) else (0.0, 1.0)
    fill_share = 1 - len(rest) / max(len(sample), 1)
    return Stretch(float(low), float(high), tuple(fills), fill_share)


def _isolated_end(values: NDArray, n_all: int) -> list[float]:
    """The smallest distinct values, at most _MAX_FILLS, if they are fill values; else [].

    Fill values are values that many pixels have, and whose distance to all other values exceeds the range of the other
    values.
    """
    distinct, counts = np.unique(values, return_counts=True)
    for n_fills in range(min(_MAX_FILLS, len(distinct) - 2), 0, -1):
        if counts[:n_fills].sum() < max(_MIN_FILL_FRACTION * n_all, 2):
            break
        rest = values[values >= distinct[n_fills]]
        low, high = np.percentile(rest, PERCENT)
        # If all other values are equal, their range is 0, and any distance would exceed it.
        if high > low and float(distinct[n_fills]) - float(distinct[n_fills - 1]) > high - low:
            return [float(value) for value in distinct[:n_fills]]
    return []
