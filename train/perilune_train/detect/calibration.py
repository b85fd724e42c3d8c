"""Convert scores of merged, suppressed detections to probabilities of a match with a label.

The network's score is trained to equal the IoU of a box with its label, so it is not a probability. The map is beta
calibration (Kull, Silva Filho and Flach, 2017, https://proceedings.mlr.press/v54/kull17a.html): with the score s,

    logit p = a ln s - b ln(1 - s) + c,    a >= 0, b >= 0, a + b > 0

The map increases strictly, so it changes neither the order of detections nor AP, and a threshold moves with it. With
a = b it is Platt's calibration of the logit.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

Array = NDArray[np.float64]
MIN_EACH = 50
"""Smallest number of matched detections, and of false ones, from which a calibration is fitted."""
_SMALLEST, _LARGEST = 1e-12, 1 - 2.0**-25
"""Scores are limited to this range: the network's scores are float32, whose largest value below 1 is 1 - 2^-24."""
_GRADIENT = 1e-10
"""Gradient of the mean log-likelihood at which a fit ends."""


@dataclass(frozen=True)
class Calibration:
    """Parameters of the map from a score to a probability."""

    log_score: float
    """a, factor of ln s."""
    log_complement: float
    """b, factor of -ln(1 - s)."""
    offset: float
    """c."""

    def probabilities(self, scores: NDArray[Any]) -> Array:
        """Probabilities (D,) of scores (D,)."""
        log, complement, _ = log_features(scores).T
        # No matrix product: it would round a single score differently, and thresholds are single scores.
        logit = self.log_score * log + self.log_complement * complement + self.offset
        return np.asarray(1 / (1 + np.exp(-logit)))

    def probability(self, score: float) -> float:
        """Probability of one score."""
        return float(self.probabilities(np.array([score]))[0])

    @property
    def formula(self) -> str:
        """The map as a formula of the score s in Python, for files that leave the package."""
        a, b, c = self.log_score, self.log_complement, self.offset
        return f"1 / (1 + exp(-({a:.6g} * log(s) - {b:.6g} * log(1 - s) {c:+.6g})))"


def fit_calibration(scores: NDArray[Any], matched: NDArray[np.bool_]) -> Calibration | None:
    """Fit the map to the scores (D,) of detections that match a label or do not (D,), by maximum likelihood.

    Returns None if there are fewer than MIN_EACH matched or false detections, or if the share of matches does not
    increase with the score.
    """
    n_matched, n_false = int(matched.sum()), int((~matched).sum())
    if min(n_matched, n_false) < MIN_EACH:
        return None
    features = log_features(scores)
    # Platt's targets keep the fit finite if a score separates the two kinds.
    target = np.where(matched, (n_matched + 1) / (n_matched + 2), 1 / (n_false + 2))
    for used in ([0, 1, 2], [0, 2], [1, 2]):
        found = np.zeros(3)
        found[used] = logistic_fit(features[:, used], target)
        if (found[:2] >= 0).all() and found[:2].any():
            return Calibration(*found.tolist())
    return None


def log_features(scores: NDArray[Any]) -> Array:
    """Columns (D, 3) ln s, -ln(1 - s) and 1 of scores (D,)."""
    limited = np.clip(np.asarray(scores, np.float64), _SMALLEST, _LARGEST)
    return np.column_stack([np.log(limited), -np.log1p(-limited), np.ones(len(limited))])


def logistic_fit(features: Array, target: Array) -> Array:
    """Coefficients (K,) of the logistic regression of targets (N,) on features (N, K), by maximum likelihood."""

    def loss(coefficients: Array) -> tuple[float, Array]:
        logit = features @ coefficients
        value = np.sum(np.logaddexp(0, logit) - target * logit)
        return float(value) / len(target), features.T @ (expit(logit) - target) / len(target)

    def curvature(coefficients: Array) -> Array:
        probability = expit(features @ coefficients)
        weight = probability * (1 - probability) / len(target)
        return np.asarray(features.T @ (features * weight[:, None]))

    start = np.zeros(features.shape[1])
    fit = minimize(loss, start, jac=True, hess=curvature, method="trust-exact", options={"gtol": _GRADIENT})
    return np.asarray(fit.x)
