"""Check whether the measurements of the last seconds agree with the state within the stated errors.

A wrong statement about a sensor (its mounting, its unit, its errors) makes innovations too large. The state then
follows the sensors with the smallest stated errors, and its covariance does not show the error. The sum of squared
normalised innovations over a window shows it: it has the chi-squared distribution if the stated errors are true (test
on the normalised innovation squared, Bar-Shalom, Li & Kirubarajan 2001, section 5.4). Errors that the filter
estimates, such as the mounting, absorb innovations. Their estimates are therefore compared with their stated
deviations. The errors of the camera are constant, so their estimates have the covariance P0 - P if P0 and P are the
covariances of the errors at the start and now: estimates that are large compared with what the frames can have taught
are improbable, even if they are small compared with P0.
"""

from collections import deque
from functools import cache

import numpy as np
from scipy.stats import chi2

from perilune_shared.geometry.frames import Array
from perilune_train.landing.filter.state import COMMON, FORCE_BIAS, GYRO_BIAS, MOUNTING, TIME_TAG, State
from perilune_train.landing.filter.update import gate

WINDOW_S = 15.0
"""Length of the window, seconds."""
_FALSE_ALARM_SHARE = 1e-5
"""Probability that a window of consistent, independent innovations raises an alarm."""
_MIN_MEASUREMENTS = 3
"""Smallest number of measurements of a sensor that raises an alarm."""
CRATER_FIXES = "crater fixes"
_BIASES = {"gyroscope": GYRO_BIAS, "accelerometer": FORCE_BIAS}
"""Parts of the error state with a random walk, by sensor."""
_CAMERA = np.r_[COMMON, MOUNTING, TIME_TAG]
"""Parts of the error state that are constant during a flight and belong to the camera: the filter cannot always tell
them apart."""
_CAMERA_FALSE_ALARM_SHARE = 1e-3
"""Probability of estimated camera errors, at one time, that raises an alarm. In 20 validation flights with true
statements, the smallest probability was 0.13."""
_START_SHARE = 1.05
"""Factor of P0 in P0 - P, which keeps the difference invertible."""


class Consistency:
    """Squared normalised innovations of each sensor in a sliding window."""

    def __init__(self, start: State):
        """Begin at the first frame; the covariance of `start` holds the stated deviations."""
        self._start = start.covariance[: TIME_TAG.stop, : TIME_TAG.stop].copy()
        self._squares: dict[str, deque[tuple[float, float, int]]] = {}

    def add(self, sensor: str, time_s: float, squared: float, n_parts: int) -> None:
        """Add the squared normalised innovation of a measurement of `n_parts` numbers.

        The value is limited to twice the gate. A single wrong measurement therefore raises no alarm.
        """
        window = self._squares.setdefault(sensor, deque())
        window.append((time_s, min(squared, 2 * gate(n_parts)), n_parts))

    def disagreeing(self, state: State) -> tuple[str, ...]:
        """The sensors whose innovations in the window that ends now, or whose estimated errors, are too large."""
        found = [sensor for sensor, part in _BIASES.items() if self._is_implausible(state, part)]
        if self._has_implausible_camera(state):
            found.append("camera")
        for sensor, window in self._squares.items():
            while window and window[0][0] <= state.time_s - WINDOW_S:
                window.popleft()
            squared, n_parts = sum(entry[1] for entry in window), sum(entry[2] for entry in window)
            if len(window) >= _MIN_MEASUREMENTS and squared > _limit(n_parts):
                found.append(sensor)
        return tuple(sorted(found))

    def _is_implausible(self, state: State, part: slice) -> bool:
        """Whether estimated errors are larger than their stated deviations allow; errors stated as 0 stay 0."""
        variance = np.diag(self._start)[part]
        known = variance > 0
        squared = (_errors(state)[part][known] ** 2 / variance[known]).sum()
        return bool(squared > _limit(int(known.sum())))

    def _has_implausible_camera(self, state: State) -> bool:
        """Whether the estimated errors of the camera are improbable together; errors stated as 0 stay 0."""
        known = _CAMERA[np.diag(self._start)[_CAMERA] > 0]
        learnt = _START_SHARE * self._start[np.ix_(known, known)] - state.covariance[np.ix_(known, known)]
        errors = _errors(state)[known]
        return bool(errors @ np.linalg.solve(learnt, errors) > _limit(len(known), _CAMERA_FALSE_ALARM_SHARE))


def _errors(state: State) -> Array:
    """Estimated errors (25,) of the sensors; 0 where the state is no error."""
    values = np.zeros(TIME_TAG.stop)
    values[GYRO_BIAS], values[FORCE_BIAS], values[COMMON] = (
        state.gyro_bias_radps,
        state.force_bias_mps2,
        state.common_px,
    )
    values[MOUNTING], values[TIME_TAG] = state.mounting_rad, state.time_tag_s
    return values


@cache
def _limit(n_parts: int, false_alarm_share: float = _FALSE_ALARM_SHARE) -> float:
    return float(chi2.isf(false_alarm_share, n_parts)) if n_parts else np.inf
