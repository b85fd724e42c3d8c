"""Flights between two frames equal the filter that changes its whole covariance at every measurement."""

from dataclasses import fields, replace

import numpy as np
import pytest
from tests.train.landing.filter import plain_filter

from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_shared.geometry.inertial_grades import GRADES
from perilune_train.landing.filter.propagate import Increments, InertialNoise
from perilune_train.landing.filter.state import N_ERRORS, State, cross_matrices, rotation_matrices
from perilune_train.landing.filter.stretch import Stretch

NOISE, RELIEF_M = InertialNoise.of(GRADES["tactical"]), 8.0
N_CRATERS, N_PAST, N_STEPS = 5, 2, 24
SIGMAS = np.array([20.0] * 3 + [1.0] * 3 + [5e-3] * 3 + [5e-5] * 3 + [1e-2] * 3)


def some_state(seed):
    """A state with craters and earlier poses, all parts of whose error are correlated."""
    rng = np.random.default_rng(seed)
    n = N_ERRORS + 2 * N_CRATERS + 6 * N_PAST
    scale = np.concatenate(
        [
            SIGMAS,
            [0.1] * 5,
            [5.0],
            [1e-3] * 3,
            [0.02],
            [1.0] * 2 * N_CRATERS,
            N_PAST * [10.0, 10, 10, 5e-3, 5e-3, 5e-3],
        ]
    )
    root = scale[:, None] * (np.eye(n) + 0.3 * rng.normal(size=(n, n)))
    turns = np.array([matrix_from_rotation_vector(0.1 * turn) for turn in rng.normal(size=(1 + N_PAST, 3))])
    return State(
        3.0,
        np.array([30.0, -40, 900]) + rng.normal(size=3),
        np.array([5.0, 2, -30]) + rng.normal(size=3),
        turns[0],
        1e-4 * rng.normal(size=3),
        1e-2 * rng.normal(size=3),
        0.1 * rng.normal(size=5),
        3.0,
        np.arange(N_CRATERS),
        rng.normal(size=(N_CRATERS, 2)),
        root @ root.T,
        100 * rng.normal(size=(N_PAST, 3)),
        turns[1:],
    )


def assert_same(one, other):
    scale = np.sqrt(np.diag(other.covariance))
    np.testing.assert_allclose(
        one.covariance / scale / scale[:, None], other.covariance / scale / scale[:, None], atol=1e-9
    )
    for field in fields(State):
        if field.name != "covariance":
            found, expected = getattr(one, field.name), getattr(other, field.name)
            # Corrections of earlier attitudes are added up, and not applied one after the other.
            atol = 1e-6 if field.name == "past_rotation_site_from_body" else 1e-9
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=atol, err_msg=field.name)


@pytest.mark.parametrize("n_flights", [1, 3])
def test_measurements_between_frames_have_the_effect_of_whole_updates(n_flights):
    rng, states = np.random.default_rng(9), [some_state(seed) for seed in range(n_flights)]
    time_s, step = 3 + 0.05 * np.arange(1, N_STEPS + 1), np.full(N_STEPS, 0.05)
    rate = 0.05 * rng.normal(size=(n_flights, N_STEPS, 3))
    force = np.array([0, 0, 1.6]) + 0.3 * rng.normal(size=rate.shape)
    measured = Increments(time_s, step, rate, force)
    stretch, accepted = Stretch(states, NOISE, RELIEF_M), []
    for begin in range(0, N_STEPS, 6):
        stretch.inertial(measured.part(slice(begin, begin + 6)))
        for k in range(begin, begin + 6):
            states = [
                plain_filter.propagated(one, time_s[k], rate[number, k], force[number, k], NOISE, RELIEF_M)
                for number, one in enumerate(states)
            ]
        # The last one is refused in all flights but the first.
        ground_m = np.array([-20.0, 10.0, 15.0])[:n_flights] + (begin == 18) * np.array([0, 300.0, -300])[:n_flights]
        range_m = 900.0 - 10 * begin / 6
        accepted.append(stretch.range(range_m, ground_m, 2.0))
        states = [plain_filter.ranged(one, range_m, ground, 2.0) for one, ground in zip(states, ground_m, strict=True)]
        if begin == 6:
            # A gap in the measurements: what comes before the next one is unknown.
            stretch.coast(stretch.time_s + 0.01)
            states = [plain_filter.coasted(one, one.time_s + 0.01) for one in states]
    assert np.all(accepted[:3]) and accepted[3].tolist() == [True, False, False][:n_flights]
    for found, expected in zip(stretch.states(), states, strict=True):
        assert_same(found, expected)
        np.testing.assert_array_equal(found.covariance, found.covariance.T)


BEAM = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])


@pytest.mark.parametrize("n_flights", [1, 3])
def test_beams_and_star_trackers_have_the_effect_of_whole_updates(n_flights):
    rng, states = np.random.default_rng(5), [some_state(seed) for seed in range(n_flights)]
    stretch = Stretch(states, NOISE, RELIEF_M)
    force, rate = np.tile([0.1, -0.1, 1.6], (3, 1)), 0.02 * rng.normal(size=(3, 3))
    attitude = states[0].rotation_site_from_body @ matrix_from_rotation_vector(np.array([4e-4, -2e-4, 3e-4]))
    sigmas, ground_m = np.array([1e-4, 2e-4, 3e-4]), np.array([10.0, 11.0, 12.0])[:n_flights]
    for k in range(3):
        end_s = 3.05 + 0.05 * k
        stretch.inertial(Increments(np.array([end_s]), np.array([0.05]), rate[[k]], force[[k]]))
        assert stretch.range(1000.0, ground_m, 3.0, BEAM).all()
        assert stretch.line_speed(25.0, 0.05, BEAM)[0]
        accepted = stretch.attitude(attitude, sigmas)
        for number, state in enumerate(states):
            state = plain_filter.propagated(state, end_s, rate[k], force[k], NOISE, RELIEF_M)
            state = plain_filter.along(state, 1000.0, ground_m[number], 3.0, BEAM)
            state = plain_filter.sped(state, 25.0, 0.05, BEAM)
            states[number] = plain_filter.turned(state, attitude, sigmas)
            assert accepted[number] == (states[number] is not state)
    for found, expected in zip(stretch.states(), states, strict=True):
        scale = np.sqrt(np.diag(expected.covariance))
        # The three axes of an attitude are applied one after the other, which differs by second-order terms.
        error = np.concatenate(
            [
                found.pose_error(expected.position_m, expected.rotation_site_from_body),
                expected.velocity_mps - found.velocity_mps,
                expected.gyro_bias_radps - found.gyro_bias_radps,
            ]
        )
        of_error = [*range(3), *range(6, 9), *range(3, 6), *range(9, 12)]
        assert np.abs(error / scale[of_error]).max() < 0.05
        difference = (found.covariance - expected.covariance) / scale / scale[:, None]
        np.testing.assert_allclose(difference, 0, atol=1e-4)


def test_contradicting_measurements_are_refused_and_counted():
    state = some_state(0)
    stretch = Stretch([state], NOISE, RELIEF_M)
    upside_down = state.rotation_site_from_body @ np.diag([1.0, -1.0, -1.0])
    # The rotation vector of half a turn has no direction: turn a little less.
    upside_down = upside_down @ matrix_from_rotation_vector(np.array([0.3, 0, 0]))
    assert not stretch.attitude(upside_down, np.full(3, 1e-3))[0]
    assert not stretch.line_speed(500.0, 0.05, BEAM)[0]
    assert not stretch.range(5.0, np.zeros(1), 1.0, -BEAM)[0]
    assert stretch.n_refused.tolist() == [3]
    assert_same(stretch.states()[0], state)


def test_a_gap_is_coasted_to_the_begin_of_the_next_measurement():
    state, force = some_state(0), np.array([0.1, 0.2, 1.5])
    stretch = Stretch([state], NOISE, RELIEF_M)
    rates = np.full((3, 3), 0.01)
    stretch.inertial(Increments(np.array([3.1, 3.5, 3.6]), np.full(3, 0.1), rates, np.tile(force, (3, 1))))
    expected = plain_filter.propagated(state, 3.1, rates[0], force, NOISE, RELIEF_M)
    expected = plain_filter.coasted(expected, 3.4)
    for end_s in (3.5, 3.6):
        expected = plain_filter.propagated(expected, end_s, rates[0], force, NOISE, RELIEF_M)
    assert_same(stretch.states()[0], expected)


def test_old_and_missing_measurements_are_ignored_and_a_part_of_one_is_used():
    state, force = some_state(1), np.array([0.1, 0.2, 1.5])
    rates = np.array([[0.3] * 3, [np.nan, 0, 0], [0.02] * 3])
    measured = Increments(np.array([2.95, 3.02, 3.04]), np.array([0.05, 0.02, 0.02]), rates, np.tile(force, (3, 1)))
    stretch = Stretch([state], NOISE, RELIEF_M)
    stretch.inertial(measured.part(slice(0, 2)))
    assert stretch.time_s == state.time_s
    stretch.inertial(measured.measured().part(slice(1, 2)).until(3.03))
    assert_same(stretch.states()[0], plain_filter.propagated(state, 3.03, rates[2], force, NOISE, RELIEF_M))
    stretch.inertial(measured)
    assert stretch.time_s == 3.04


def test_many_rotations_at_once():
    rng = np.random.default_rng(0)
    turns, other = rng.normal(size=(2, 7, 3)), rng.normal(size=(2, 7, 3))
    turns[0, 0] = 0
    expected = [[matrix_from_rotation_vector(turn) for turn in row] for row in turns]
    np.testing.assert_allclose(rotation_matrices(turns), expected, atol=1e-15)
    np.testing.assert_allclose((cross_matrices(turns) @ other[..., None])[..., 0], np.cross(turns, other), atol=1e-15)


def test_a_state_keeps_the_covariance_of_craters_that_stay():
    state = some_state(2)
    craters = np.array([7, 3, 9, 0])
    after = state.with_craters(craters, np.array([1.0, 2.0, 3.0, 4.0]))
    craters_before = [N_ERRORS + 6, N_ERRORS + 7, N_ERRORS, N_ERRORS + 1]
    places = [*range(N_ERRORS), *craters_before, *range(N_ERRORS + 2 * N_CRATERS, len(state.covariance))]
    kept = [*range(N_ERRORS), *range(N_ERRORS + 2, N_ERRORS + 4), *range(N_ERRORS + 6, N_ERRORS + 8 + 6 * N_PAST)]
    np.testing.assert_array_equal(after.covariance[np.ix_(kept, kept)], state.covariance[np.ix_(places, places)])
    new = [N_ERRORS, N_ERRORS + 1, N_ERRORS + 4, N_ERRORS + 5]
    np.testing.assert_array_equal(after.covariance[np.ix_(new, new)], np.diag([1.0, 1, 9, 9]))
    assert not after.covariance[np.ix_(new, kept)].any() and not after.covariance[np.ix_(kept, new)].any()
    np.testing.assert_array_equal(after.offsets_m, [[0, 0], state.offsets_m[3], [0, 0], state.offsets_m[0]])
    empty = replace(state, craters=np.zeros(0, int), offsets_m=np.zeros((0, 2)), covariance=np.eye(N_ERRORS + 12))
    assert empty.with_craters(craters, np.ones(4)).covariance.shape == (N_ERRORS + 20,) * 2
