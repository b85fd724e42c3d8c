"""The test on the squared normalised innovations of the last seconds."""

from dataclasses import replace

import numpy as np
import pytest

from perilune_train.landing.filter.consistency import WINDOW_S, Consistency
from perilune_train.landing.filter.state import MOUNTING, CameraErrors, State

START = State.starting(np.zeros(3), np.zeros(3), np.eye(3), np.ones(15), 5.0, CameraErrors(30.0, 0.1, 0.0))


def at(time_s):
    return replace(START, time_s=time_s)


@pytest.mark.parametrize(("n_parts", "step_s"), [(6, 1.7), (3, 1.0), (1, 0.1)])
def test_consistent_innovations_raise_no_alarm_and_large_ones_do(n_parts, step_s):
    rng = np.random.default_rng(0)
    healthy, faulty, alarms = Consistency(START), Consistency(START), []
    for k in range(2000):
        squared = float((rng.normal(size=n_parts) ** 2).sum())
        healthy.add("a", k * step_s, squared, n_parts)
        faulty.add("a", k * step_s, 4 * squared, n_parts)
        assert healthy.disagreeing(at(k * step_s)) == ()
        alarms.append(faulty.disagreeing(at(k * step_s)) == ("a",))
    started = round(WINDOW_S / step_s)
    assert np.mean(alarms[started:]) > 0.95


def test_one_wrong_measurement_raises_no_alarm_and_several_do():
    watch = Consistency(START)
    for k in range(10):
        watch.add("fixes", float(k), 1e9 if k == 4 else 6.0, 6)
        assert watch.disagreeing(at(float(k))) == ()
    for k in range(10, 14):
        watch.add("fixes", float(k), np.inf, 6)
        watch.add("ranges", float(k), 1.0, 1)
    assert watch.disagreeing(at(13.0)) == ("fixes",)
    # The window passes.
    assert watch.disagreeing(at(13.0 + WINDOW_S)) == ()


def test_a_bias_far_beyond_its_stated_deviation():
    watch = Consistency(START)
    assert watch.disagreeing(replace(START, gyro_bias_radps=np.array([3.0, 0.0, 0.0]))) == ()
    assert watch.disagreeing(replace(START, gyro_bias_radps=np.array([6.0, 0.0, 0.0]))) == ("gyroscope",)


def with_mounting(turn_deg, left_share):
    """A state whose frames have reduced the variance of the mounting to a share, and estimated a turn about X."""
    covariance = START.covariance.copy()
    covariance[MOUNTING, MOUNTING] *= left_share
    return replace(START, mounting_rad=np.radians([turn_deg, 0.0, 0.0]), covariance=covariance)


def test_an_estimated_mounting_is_compared_with_what_the_frames_can_have_taught():
    watch = Consistency(START)  # stated: 0.1 degrees
    assert watch.disagreeing(with_mounting(0.3, 0.05)) == ()
    assert watch.disagreeing(with_mounting(0.7, 0.05)) == ("camera",)
    # Frames that leave nine tenths of the variance explain no turn of 0.3 degrees.
    assert watch.disagreeing(with_mounting(0.1, 0.9)) == ()
    assert watch.disagreeing(with_mounting(0.3, 0.9)) == ("camera",)
    # The time tag is stated as exact: the filter does not estimate it.
    assert watch.disagreeing(START) == ()


def test_true_errors_of_the_camera_raise_an_alarm_as_often_as_stated():
    rng, n_alarms, n = np.random.default_rng(0), 0, 20_000
    watch = Consistency(START)
    known = np.radians(0.1) ** 2 * np.eye(3)
    for _ in range(n):
        # A measurement of the mounting with as large an error as its deviation halves the variance.
        mounting = rng.multivariate_normal(np.zeros(3), known)
        estimate = (mounting + rng.multivariate_normal(np.zeros(3), known)) / 2
        covariance = START.covariance.copy()
        covariance[MOUNTING, MOUNTING] /= 2
        n_alarms += bool(watch.disagreeing(replace(START, mounting_rad=estimate, covariance=covariance)))
    assert n_alarms / n < 1.5e-3
