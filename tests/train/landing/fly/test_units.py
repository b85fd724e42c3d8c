"""Units of inertial measurements: what is doubted, and which reading is named."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from tests.helpers import in_process
from tests.train.landing.fly.descent_files import options, write_descent

from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import GRADES
from perilune_train.cli.main import main
from perilune_train.landing.filter.propagate import Increments, start_sigmas
from perilune_train.landing.filter.state import State
from perilune_train.landing.fly.units import Prior, doubts

STEP_S, END_S = 0.05, 65.0
G, DEG = 9.80665, np.pi / 180


def prior(velocity_mps=(0.0, -8.0, -20.0)):
    sigmas = start_sigmas(60.0, 1.0, 0.5, GRADES["tactical"])
    state = State.starting(np.array([0.0, 0, 1500]), np.array(velocity_mps), np.eye(3), sigmas, 5.0)
    return Prior(state, 60.0, 1.0, np.array([0.0, 0, -1]), END_S)


def log(force_mps2=None, seed=0):
    """A descent at constant velocity on a level body that wobbles by 0.3 degrees."""
    time_s = np.arange(STEP_S, END_S + STEP_S / 2, STEP_S)
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 3)
    rates = 0.3 * DEG * 2 * np.pi / 7 * np.cos(2 * np.pi * time_s[:, None] / 7 + phase) + rng.normal(
        0, 2e-4, (len(time_s), 3)
    )
    force = -gravity_mps2(1500 - 20 * time_s) if force_mps2 is None else np.tile(force_mps2, (len(time_s), 1))
    return Increments(time_s, np.full(len(time_s), STEP_S), rates, force + rng.normal(0, 0.01, force.shape))


def scaled(measured, force=1.0, rate=1.0, up=0.0):
    forces = measured.specific_force_mps2 * force + [0, 0, up]
    return replace(measured, specific_force_mps2=forces, angular_rate_radps=measured.angular_rate_radps * rate)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"force": 1 / G}, "specific force in g (times 9.80665)"),
        ({"force": -1.0}, "specific force of the opposite sign"),
        ({"force": -1 / G}, "specific force in g and of the opposite sign"),
        ({"up": G - 1.62}, "the Earth's gravity in place of the Moon's"),
        ({"up": -1.62}, "accelerations without gravity"),
        ({"force": 1 / G, "rate": 1 / DEG}, "specific force in g (times 9.80665)"),
    ],
)
def test_another_unit_is_named_first(change, name):
    (text,) = doubts(scaled(log(), **change), prior(), is_lost=False)
    assert "where the Moon's gravity is 1.62 m/s2" in text
    assert text.split("; ")[-1].startswith(name) and text.endswith("would fit better")


def test_degrees_per_second_are_named_once_the_position_is_lost_or_the_camera_turns_away():
    wobble, turn = scaled(log(), rate=1 / DEG), log()
    assert "angular rates in degrees per second (times 0.0174533) would fit" in doubts(wobble, prior(), is_lost=True)[0]
    turn = replace(turn, angular_rate_radps=turn.angular_rate_radps + np.array([0.5 * DEG, 0, 0]))
    assert doubts(turn, prior(), is_lost=False) == []
    (text,) = doubts(scaled(turn, rate=1 / DEG), prior(), is_lost=False)
    assert "the camera turns away from the ground after 2." in text and "degrees per second (times" in text


@pytest.mark.parametrize("is_lost", [False, True])
def test_right_logs_are_not_doubted(is_lost):
    for seed in range(5):
        assert doubts(log(seed=seed), prior(), is_lost=is_lost) == []
    # Braking with 2.5 m/s2, and a hop that climbs.
    assert doubts(log([0, 0, 1.9]), prior((0.0, 0, -30)), is_lost=is_lost) == []
    assert doubts(log([0, 0, 1.6]), prior((0.0, 0, 10)), is_lost=is_lost) == []
    # Braking thrust of three times the Moon's gravity in a short time.
    short = log([0, 0, 4.9]).part(slice(0, 200))
    assert doubts(short, prior((0.0, 0, -60)), is_lost=is_lost) == []


def test_a_free_fall_is_told_as_one_and_absurd_numbers_are_no_traceback():
    (text,) = doubts(log([0, 0, 0.0]).part(slice(0, 200)), prior(), is_lost=False)
    assert "accelerations without gravity" in text
    for value in (1e300, -1e300, np.nan):
        told = doubts(scaled(log(), force=value), prior(), is_lost=True)
        assert len(told) <= 1 and all(len(text) < 600 for text in told)
    assert doubts(log().part(slice(0, 0)), prior(), is_lost=True) == []


def test_the_command_warns_before_the_flight(tmp_path):
    folder = write_descent(tmp_path / "descent")
    imu = pd.read_csv(folder / "imu.csv")
    plain = in_process.call(main, "navigate", "fly", *options(folder), "--out", tmp_path / "plain")
    # The drawn frames are not lunar, which other warnings say.
    assert plain.returncode == 0 and f"warning: {folder / 'imu.csv'}" not in plain.stderr
    imu[[f"specific_force_{axis}_mps2" for axis in "xyz"]] /= G
    imu.to_csv(folder / "imu.csv", index=False)
    done = in_process.call(main, "navigate", "fly", *options(folder), "--out", tmp_path / "flight")
    assert done.returncode == 0, done.stderr
    told = " ".join(done.stderr.split())
    assert "warning: " in told and "imu.csv: mean specific force 0.165 m/s2 upwards" in told
    assert "specific force in g (times 9.80665)" in told
