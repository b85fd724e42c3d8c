"""Jacobians against finite differences, and consistency on simulated flights."""

from dataclasses import replace

import numpy as np
from tests.train.landing.craters.crater_world import CAMERA, nearby, sighted, world
from tests.train.landing.filter import plain_filter

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY as MOUNTING
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import GRADES, HOUR_S, STANDARD_GRAVITY_MPS2
from perilune_train.landing.craters.fix import refine
from perilune_train.landing.craters.projection import Pose, projected
from perilune_train.landing.craters.sightings import PREDICTED_STATIC, STATIC_SHARE
from perilune_train.landing.filter import measurements
from perilune_train.landing.filter.propagate import Increments, InertialNoise
from perilune_train.landing.filter.state import N_ERRORS, State
from perilune_train.landing.filter.stretch import Stretch
from perilune_train.landing.filter.update import updated

NOISE = InertialNoise.of(GRADES["tactical"])
QUIET = InertialNoise(0.0, 0.0, 0.0, 0.0)


def some_state(rng):
    turn = matrix_from_rotation_vector(rng.normal(size=3) * 0.1)
    return State(
        3.0,
        np.array([30.0, -40, 900]),
        np.array([5.0, 2, -30]),
        turn,
        rng.normal(size=3) * 1e-4,
        rng.normal(size=3) * 1e-2,
        rng.normal(size=5) * 0.1,
        3.0,
        np.array([4, 9]),
        rng.normal(size=(2, 2)),
        np.eye(N_ERRORS + 4),
    )


def propagated(state, measured, noise, relief_m):
    """The state after inertial measurements."""
    stretch = Stretch([state], noise, relief_m)
    stretch.inertial(measured)
    return stretch.states()[0]


def difference(one, other):
    """The error (29,) that leads from a state to another."""
    return np.concatenate(
        [
            other.position_m - one.position_m,
            other.velocity_mps - one.velocity_mps,
            rotation_vectors(one.rotation_site_from_body.T @ other.rotation_site_from_body),
            other.gyro_bias_radps - one.gyro_bias_radps,
            other.force_bias_mps2 - one.force_bias_mps2,
            other.common_px - one.common_px,
            [other.ground_m - one.ground_m],
            other.mounting_rad - one.mounting_rad,
            [other.time_tag_s - one.time_tag_s],
            (other.offsets_m - one.offsets_m).ravel(),
        ]
    )


def test_propagation_of_errors_is_the_derivative():
    state = some_state(np.random.default_rng(0))
    rate, force = np.array([0.02, -0.03, 0.05]), np.array([0.3, -0.2, 1.7])
    rates, forces = np.array([rate, -rate]), np.array([force, 0.5 * force])
    measured = Increments(np.array([3.01, 3.03]), np.array([0.01, 0.02]), rates, forces)
    ends = propagated(state, measured, QUIET, 0.0)
    for k in range(N_ERRORS + 4):
        column = np.zeros(N_ERRORS + 4)
        column[k] = 1e-5
        moved = propagated(state.corrected(column, state.covariance), measured, QUIET, 0.0)
        found = difference(ends, moved) / 1e-5
        # With a covariance e_k e_k^T, the new covariance is the outer product of the column.
        single = State(**{**fields(state), "covariance": np.outer(column, column) * 1e10})
        outer = propagated(single, measured, QUIET, 0.0).covariance
        np.testing.assert_allclose(outer, np.outer(found, found), atol=2e-5)


def test_several_measurements_at_once_are_the_same_as_one_after_the_other():
    state, rng = some_state(np.random.default_rng(0)), np.random.default_rng(1)
    rates, forces = 0.05 * rng.normal(size=(30, 3)), [0, 0, 1.6] + 0.3 * rng.normal(size=(30, 3))
    measured = Increments(3 + 0.01 * np.arange(1, 31), np.full(30, 0.01), rates, forces)
    single = state
    for k in range(30):
        single = propagated(single, measured.part(slice(k, k + 1)), NOISE, 5.0)
    together = propagated(state, measured, NOISE, 5.0)
    np.testing.assert_allclose(difference(single, together), 0, atol=1e-9)
    np.testing.assert_allclose(together.ground_m, single.ground_m, rtol=1e-9)
    np.testing.assert_allclose(together.covariance, single.covariance, rtol=1e-6, atol=1e-12)


def fields(state):
    return {name: getattr(state, name) for name in State.__slots__}


def test_a_pose_has_the_derivative_of_its_innovation():
    state = some_state(np.random.default_rng(1))
    rate = np.array([0.05, -0.03, 0.02])
    state = replace(state, mounting_rad=np.array([2e-5, -1e-5, 3e-5]), time_tag_s=0.02, angular_rate_radps=rate)
    pose = Pose(np.array([32.0, -41, 903]), MOUNTING @ state.rotation_site_from_body.T)
    innovation, by_error = measurements._pose_innovation(state, pose, MOUNTING)
    for k in range(N_ERRORS):
        column = np.zeros(N_ERRORS + 4)
        column[k] = 1e-6
        moved, _ = measurements._pose_innovation(state.corrected(column, state.covariance), pose, MOUNTING)
        # The position at the exposure also changes with the velocity times the time tag, which the filter neglects.
        neglected = 0.02 * (3 <= k < 6)
        np.testing.assert_allclose(by_error[:, k], (innovation - moved) / 1e-6, atol=1e-3 + neglected)


def started(position, velocity, turn, sigmas, rng):
    """The state of a lander whose position, velocity and attitude are off by their deviations."""
    off = sigmas[:9] * rng.normal(size=9)
    turned = turn @ matrix_from_rotation_vector(off[6:])
    return State.starting(position + off[:3], velocity + off[3:6], turned, sigmas, 0.0)


def fly(seed):
    """Simulate a flight with known errors and filter it; returns the normalised errors squared of the poses."""
    rng, grade = np.random.default_rng(seed), GRADES["tactical"]
    step, n_steps = 0.02, 1500
    gyro = np.radians(grade.gyro_bias_deg_per_h) / HOUR_S * rng.normal(size=3)
    force = grade.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000 * rng.normal(size=3)
    position, velocity, turn = np.array([0.0, 0, 1400]), np.array([8.0, 3, -35]), np.eye(3)
    sigmas = np.concatenate(
        [
            np.full(3, 20.0),
            np.full(3, 1.0),
            np.full(3, np.radians(0.5)),
            np.full(3, np.radians(grade.gyro_bias_deg_per_h) / HOUR_S),
            np.full(3, grade.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000),
        ]
    )
    state = started(position, velocity, turn, sigmas, rng)
    found, innovations = [], []
    root = np.sqrt(step)
    for k in range(1, n_steps + 1):
        rate = 0.02 * np.array([np.sin(k * step), np.cos(0.7 * k * step), 0.3])
        thrust = np.array([0.2 * np.sin(0.5 * k * step), 0.1, 1.9])
        middle = turn @ matrix_from_rotation_vector(rate * step / 2)
        acceleration = middle @ thrust + gravity_mps2(position[2])
        position = position + velocity * step + acceleration * step**2 / 2
        velocity, turn = velocity + acceleration * step, turn @ matrix_from_rotation_vector(rate * step)
        gyro = gyro + np.sqrt(NOISE.gyro_bias) * root * rng.normal(size=3)
        force = force + np.sqrt(NOISE.force_bias) * root * rng.normal(size=3)
        seen_rate = rate + gyro + np.sqrt(NOISE.turn) / root * rng.normal(size=3)
        seen_force = thrust + force + np.sqrt(NOISE.velocity) / root * rng.normal(size=3)
        state = propagated(state, Increments.single(k * step, step, seen_rate, seen_force), NOISE, 0.0)
        if k % 50:
            continue
        camera = MOUNTING @ turn.T
        noise = np.diag([3.0] * 3 + [1e-3] * 3) ** 2
        error = np.sqrt(np.diag(noise)) * rng.normal(size=6)
        pose = Pose(position + error[:3], matrix_from_rotation_vector(error[3:]) @ camera)
        innovation, by_error = measurements._pose_innovation(state, pose, MOUNTING)
        spread = by_error @ state.covariance[:N_ERRORS, :N_ERRORS] @ by_error.T + noise
        innovations.append(innovation @ np.linalg.solve(spread, innovation))
        state = updated(state, innovation, by_error @ state.covariance[:N_ERRORS], spread)
        stretch = Stretch([state], NOISE, 0.0)
        stretch.range(position[2] / turn[2, 2] + 2 * rng.normal(), np.zeros(1), 2.0)
        (state,) = stretch.states()
        error = state.pose_error(position, turn)
        own = [*range(3), *range(6, 9)]
        found.append(error @ np.linalg.solve(state.covariance[np.ix_(own, own)], error))
    return np.mean(found), np.mean(innovations)


def test_errors_have_the_stated_size():
    squared, innovation = np.mean([fly(seed) for seed in range(20)], axis=0)
    # Poses along a flight are correlated: 20 flights have about 60 independent ones, a deviation of 0.45.
    assert 4.8 < squared < 7.2
    assert 5.4 < innovation < 6.6


def test_heights_of_the_catalogue_are_noise_where_they_are_seen(monkeypatch):
    rng, caught = np.random.default_rng(2), {}

    def catch(state, innovation, crossed, spread):
        caught["spread"] = spread
        return updated(state, innovation, crossed, spread)

    monkeypatch.setattr(measurements, "updated", catch)
    # The state is far too certain for the errors of these sightings; keep all of them.
    monkeypatch.setattr(measurements, "gate", lambda n_parts: np.inf)
    monkeypatch.setattr(measurements, "_MIN_PROBABILITY", 0.0)
    catalogue = replace(world(), position_sigma_m=3.0)
    true = Pose(np.array([20.0, -30, 700]), MOUNTING)
    seen = sighted(catalogue, true, rng, false_share=0.0)
    fix = refine(seen, catalogue, CAMERA, nearby(true, np.zeros(3), np.zeros(3)), true)
    state = State.starting(fix.pose.position_m, np.zeros(3), np.eye(3), np.zeros(15), 5.0)
    # Without uncertainty of the state, the spread is the noise.
    n_used = int((fix.weight > 0.1).sum())
    known = replace(state, covariance=np.zeros((N_ERRORS + 2 * n_used,) * 2), offsets_m=np.zeros((n_used, 2)))
    known = replace(known, craters=fix.crater[fix.weight > 0.1])
    measurements.craters_update(known, fix, seen, catalogue, CAMERA, MOUNTING)
    higher = replace(catalogue, centre_m=catalogue.centre_m + np.array([0, 0, 3.0]))
    used = fix.weight > 0.1
    shift = np.zeros((used.sum(), 2))
    for k, crater in enumerate(fix.crater[used]):
        before, after = (
            projected(one.part(np.array([crater])), CAMERA, fix.pose, np.inf, 0.0) for one in (catalogue, higher)
        )
        shift[k] = (after.centre_px - before.centre_px)[0]
    assert np.abs(shift).max() > 0.4, "some craters are far from the middle"
    for k, (weight, own) in enumerate(zip(fix.weight[used], fix.sighting[used], strict=True)):
        block = caught["spread"][2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
        expected = seen.noise_px[own] ** 2 / weight * np.eye(2) + np.outer(shift[k], shift[k])
        np.testing.assert_allclose(block, expected, rtol=0.02, atol=1e-3)


def test_a_new_crater_has_the_offset_that_its_sighting_predicts():
    rng = np.random.default_rng(2)
    catalogue = replace(world(), position_sigma_m=1.0)
    true = Pose(np.array([20.0, -30, 700]), MOUNTING)
    seen = sighted(catalogue, true, rng, false_share=0.0)
    sigma_px = np.where(np.arange(len(seen)) % 2, np.nan, np.linspace(0.2, 1.5, len(seen)))
    seen = replace(seen, sigma_px=sigma_px)
    fix = refine(seen, catalogue, CAMERA, nearby(true, np.zeros(3), np.zeros(3)), true)
    sigmas = np.repeat([1.0, 0.1, np.radians(0.1), 1e-6, 1e-6], 3)
    state = State.starting(true.position_m, np.zeros(3), np.eye(3), sigmas, 5.0)
    found = measurements.crater_innovations(state, fix, seen, catalogue, CAMERA, MOUNTING).state
    deviation_m = np.sqrt(np.diag(found.covariance)[N_ERRORS::2])
    of_crater = dict(zip(found.craters.tolist(), deviation_m, strict=True))
    kinds = set()
    for crater, sighting in zip(fix.crater.tolist(), fix.sighting.tolist(), strict=True):
        if crater not in of_crater:
            continue
        metres = (fix.pose.position_m[2] - catalogue.centre_m[crater, 2]) / CAMERA.fx_px
        predicted = not np.isnan(sigma_px[sighting])
        own_m = (
            metres * PREDICTED_STATIC * sigma_px[sighting] if predicted else STATIC_SHARE * catalogue.radius_m[crater]
        )
        # The camera is level to a degree, so that the depth of a crater is nearly its height below the camera.
        np.testing.assert_allclose(of_crater[crater], np.hypot(1.0, own_m), rtol=0.01)
        kinds.add(predicted)
    assert kinds == {True, False}


def part(fix, chosen):
    """A fix with the chosen matches only."""
    return replace(fix, sighting=fix.sighting[chosen], crater=fix.crater[chosen], weight=fix.weight[chosen])


def test_a_sighting_that_contradicts_the_offset_of_its_crater_is_left_out(monkeypatch):
    monkeypatch.setattr(measurements, "_MIN_PROBABILITY", 0.0)
    rng = np.random.default_rng(5)
    catalogue = replace(world(), position_sigma_m=1.0)
    true = Pose(np.array([20.0, -30, 700]), MOUNTING)
    sigmas = np.repeat([1.0, 0.1, np.radians(0.1), 1e-6, 1e-6], 3)
    state = State.starting(true.position_m, np.zeros(3), np.eye(3), sigmas, 5.0)

    def updated_by(state, seen, wrong=None):
        fix = refine(seen, catalogue, CAMERA, nearby(true, np.zeros(3), np.zeros(3)), true)
        chosen = np.flatnonzero(fix.weight > 0.5)
        moved = seen.centre_px.copy()
        if wrong is not None:
            moved[fix.sighting[chosen[10]]] += wrong
        kept = np.isin(np.arange(len(fix.weight)), chosen if wrong is None else np.delete(chosen, 10))
        return part(fix, kept), part(fix, chosen), replace(seen, centre_px=moved)

    for _ in range(3):
        seen = sighted(catalogue, true, rng, static=False, false_share=0.0)
        _, fix, seen = updated_by(state, seen)
        state = measurements.craters_update(state, fix, seen, catalogue, CAMERA, MOUNTING)
    without, fix, wrong = updated_by(state, sighted(catalogue, true, rng, static=False, false_share=0.0), 6.0)
    expected = measurements.craters_update(state, without, wrong, catalogue, CAMERA, MOUNTING)
    found = measurements.craters_update(state, fix, wrong, catalogue, CAMERA, MOUNTING)
    np.testing.assert_allclose(found.position_m, expected.position_m, atol=1e-9)
    np.testing.assert_allclose(found.covariance[:25, :25], expected.covariance[:25, :25], atol=1e-12)


def test_craters_update_as_the_whole_filter(monkeypatch):
    """The blocks of the derivative give the update of the whole derivative."""
    rng, caught = np.random.default_rng(3), {}

    def catch(state, innovation, crossed, spread):
        caught.update(state=state, innovation=innovation, crossed=crossed, spread=spread)
        return updated(state, innovation, crossed, spread)

    def catch_blocks(state, crater, by_error, by_offset):
        caught.update(crater=crater, by_error=by_error, by_offset=by_offset)
        return crossed_by(state, crater, by_error, by_offset)

    crossed_by = measurements._crossed
    monkeypatch.setattr(measurements, "updated", catch)
    monkeypatch.setattr(measurements, "_crossed", catch_blocks)
    monkeypatch.setattr(measurements, "gate", lambda n_parts: np.inf)
    monkeypatch.setattr(measurements, "_MIN_PROBABILITY", 0.0)
    catalogue = replace(world(), position_sigma_m=1.0)
    true = Pose(np.array([20.0, -30, 700]), MOUNTING)
    state = State.starting(true.position_m + np.array([3.0, 2, 1]), np.zeros(3), np.eye(3), np.ones(15), 5.0)
    for _ in range(2):
        seen = sighted(catalogue, true, rng)
        fix = refine(seen, catalogue, CAMERA, nearby(true, np.zeros(3), np.zeros(3)), true)
        after = measurements.craters_update(state, fix, seen, catalogue, CAMERA, MOUNTING)
        before, n = caught["state"], len(caught["crater"])
        by_error = np.zeros((n, 2, len(before.covariance)))
        by_error[:, :, [*range(3), *range(6, 9), *range(15, 20), *range(21, 25)]] = caught["by_error"]
        for k, crater in enumerate(caught["crater"]):
            by_error[k, :, N_ERRORS + 2 * crater : N_ERRORS + 2 * crater + 2] = caught["by_offset"][k]
        by_error = by_error.reshape(2 * n, -1)
        np.testing.assert_allclose(caught["crossed"], by_error @ before.covariance, rtol=1e-9, atol=1e-9)
        noise = caught["spread"] - by_error @ before.covariance @ by_error.T
        expected = plain_filter.updated(before, caught["innovation"], by_error, noise, gated=False)
        np.testing.assert_allclose(after.covariance, expected.covariance, atol=1e-8)
        np.testing.assert_allclose(difference(after, expected), 0, atol=1e-8)
        state = after
