"""Bands and bounds of a Monte Carlo run.

All of them describe further draws on the descents that were flown. They say nothing about other scenes.
"""

import numpy as np
from scipy.stats import beta, binom, chi2

from perilune_shared.geometry.frames import Array

CONFIDENCE = 0.95
"""Confidence of all bounds."""
BOUND_SHARE = 0.99
"""Share of flights whose miss distance is bounded."""


def mean_band(parts: int | Array, n_draws: int | Array, share: float = 0.95) -> tuple[Array, Array]:
    """Ends of the interval that contains the mean of `n_draws` sums of `parts` squared standard normal numbers.

    The interval contains the mean with probability `share` if the draws are independent.
    """
    total, n = np.asarray(parts) * np.asarray(n_draws), np.asarray(n_draws)
    low, high = (chi2.ppf(edge, total) / n for edge in ((1 - share) / 2, (1 + share) / 2))
    return low, high


def share_bound(count: int, n_flights: int, confidence: float = CONFIDENCE) -> float:
    """Upper one-sided bound of a probability, from `count` of `n_flights` (Clopper & Pearson 1934)."""
    return 1.0 if count >= n_flights else float(beta.ppf(confidence, count + 1, n_flights - count))


def quantile_bound(values: Array, share: float, confidence: float = CONFIDENCE) -> float:
    """Upper bound of the quantile `share` of a distribution, from independent values (n,); NaN with too few values.

    The bound is the least order statistic that is not below the quantile with the given confidence, for any continuous
    distribution (Wilks 1941): the number of values below the quantile is binomial.
    """
    ordered = np.sort(values)
    enough = binom.cdf(np.arange(len(ordered)), len(ordered), share) >= confidence
    return float(ordered[enough.argmax()]) if enough.any() else float("nan")


def needed_draws(share: float, confidence: float = CONFIDENCE) -> int:
    """Smallest number of draws with which `quantile_bound` is defined."""
    return int(np.ceil(np.log(1 - confidence) / np.log(share) - 1e-9))


def supported_share(n_draws: int, confidence: float = CONFIDENCE) -> float:
    """Largest quantile that `n_draws` draws bound: by their largest value."""
    return float((1 - confidence) ** (1 / n_draws))


def ellipse(covariance: Array, share: float = 0.95) -> tuple[float, float, float]:
    """Semi-axes of the ellipse that contains `share` of a two-dimensional normal distribution.

    Returns the major and the minor semi-axis, and the direction of the major axis in degrees from x to y, from 0 to
    180.
    """
    values, vectors = np.linalg.eigh(covariance)
    minor, major = np.sqrt(np.maximum(values, 0) * chi2.ppf(share, 2))
    return float(major), float(minor), float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180)
