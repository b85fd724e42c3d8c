"""The test on the squared normalised innovations of the last seconds."""

from dataclasses import replace

import numpy as np
import pytest

from perilune_train.landing.filter.consistency import WINDOW_S, Consistency
from perilune_train.landing.filter.state import CameraErrors, State

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


def test_an_estimated_error_far_beyond_its_stated_deviation():
    watch = Consistency(START)
    likely, unlikely = (replace(START, mounting_rad=np.radians([turn_deg, 0.0, 0.0])) for turn_deg in (0.3, 0.6))
    assert watch.disagreeing(likely) == ()
    assert watch.disagreeing(unlikely) == ("camera mounting",)
    # Stated as exact: the filter cannot estimate it.
    assert watch.disagreeing(replace(START, time_tag_s=0.0)) == ()
