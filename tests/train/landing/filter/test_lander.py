"""A simulated descent over craters whose places are wrong, from inertial measurements, ranges and sightings."""

import dataclasses

import numpy as np
import pytest
from tests.train.landing.craters.crater_world import CAMERA, ground_m, sighted, world

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY as MOUNTING
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_grades import GRADES, HOUR_S, STANDARD_GRAVITY_MPS2
from perilune_train.landing.craters.catalogue import CatalogueErrors, with_errors
from perilune_train.landing.craters.projection import Pose
from perilune_train.landing.craters.sightings import STATIC_SHARE, Sightings
from perilune_train.landing.filter.flight import DopplerLidar, Instruments, StarTracker, fly, fly_together, together
from perilune_train.landing.filter.lander import Beam, Lander, LidarErrors, Surroundings
from perilune_train.landing.filter.propagate import Increments, InertialNoise
from perilune_train.landing.filter.state import EXACT_CAMERA, N_ERRORS, CameraErrors, State

GRADE = GRADES["tactical"]
NOISE = InertialNoise.of(GRADE)
WORLD = world()
STEP_S = 0.05
POSITION_M, VELOCITY_MPS = np.array([-300.0, 100, 1400]), np.array([9.0, -4, -35])
NOTHING = Sightings(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def lander(seed, off_m=20.0, claimed_m=20.0, moved_m=0.0, camera=EXACT_CAMERA):
    """A lander whose start is off, its catalogue with errors, and the generator of its measurements."""
    rng = np.random.default_rng(seed)
    biases = np.radians(GRADE.gyro_bias_deg_per_h) / HOUR_S, GRADE.accelerometer_bias_mg * STANDARD_GRAVITY_MPS2 / 1000
    sigmas = np.repeat([claimed_m, 1.0, np.radians(0.3), *biases], 3)
    position = POSITION_M + off_m * rng.normal(size=3) + [moved_m, 0, 0]
    start = State.starting(position, VELOCITY_MPS + rng.normal(size=3), np.eye(3), sigmas, 5.0, camera)
    catalogue = with_errors(WORLD, CatalogueErrors(), rng)
    return Lander(start, NOISE, Surroundings(CAMERA, MOUNTING, catalogue, 2.0, 5.0)), rng, biases


def flown(craft, rng, biases, see=lambda k, seen: seen, seconds=30, feel=lambda k: True, mounting=MOUNTING, late_s=0.0):
    """Fly a straight line; returns position errors (n, 3), normalised errors squared (n,), and statuses by frame."""
    # What repeats with a crater is drawn once.
    shift = STATIC_SHARE * WORLD.radius_m[:, None] * rng.normal(size=(len(WORLD), 3)) * [1, 1, 0]
    apparent = dataclasses.replace(WORLD, centre_m=WORLD.centre_m + shift)
    gyro, force = (bias * rng.normal(size=3) for bias in biases)
    noise = np.sqrt([NOISE.turn, NOISE.velocity]) / np.sqrt(STEP_S)
    position, errors, squared, status = POSITION_M, [], [], []
    for k in range(round(seconds / STEP_S)):
        if k * STEP_S % 1 == 0:
            seen = sighted(apparent, Pose(position + late_s * VELOCITY_MPS, mounting), rng, static=False)
            craft.sightings(see(k * STEP_S, seen))
            errors.append(craft.state.position_m - position)
            own = [*range(3), *range(6, 9)]
            error = craft.state.pose_error(position, np.eye(3))
            squared.append(error @ np.linalg.solve(craft.state.covariance[np.ix_(own, own)], error))
            status.append(craft.status)
        position = position + VELOCITY_MPS * STEP_S
        rate, lift = gyro + noise[0] * rng.normal(size=3), force + noise[1] * rng.normal(size=3)
        if feel(k * STEP_S):
            lift = lift - gravity_mps2(position[2])
            craft.inertial(Increments.single((k + 1) * STEP_S, STEP_S, rate, lift))
            craft.range(position[2] - ground_m(position) + 2 * rng.normal())
    return np.array(errors), np.array(squared), status


@pytest.mark.parametrize("n_descents", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_errors_are_small_and_of_the_stated_size(n_descents):
    squared, last = [], []
    for seed in range(n_descents):
        errors, normalised, status = flown(*lander(seed))
        assert set(status) == {"tracking"}
        squared.append(normalised.mean())
        last.append(np.linalg.norm(errors[-1]))
    # Errors along a descent are correlated: 8 descents have about 16 independent ones of 6 parts, a deviation of 0.9.
    # Ambiguous matches are left out, and with them the largest errors: the filter is a little too cautious.
    assert 2.5 < np.mean(squared) < 8.7
    assert np.mean(last) < 1.5


def test_craters_missed_in_one_frame_keep_their_offsets():
    """Else their catalogue errors would count as new information when they are seen again."""
    craft, rng, _ = lander(6)
    true = Pose(POSITION_M, MOUNTING)
    seen = sighted(WORLD, true, rng)
    craft.sightings(seen)
    known, covariance = craft.state.craters, craft.state.covariance
    assert len(known) > 40
    some = Sightings(seen.centre_px[::2], seen.radius_px[::2], seen.score[::2])
    craft.sightings(some)
    lost = np.setdiff1d(known, craft.state.craters)
    # Those at the very border of the image may leave it.
    assert len(lost) < 0.05 * len(known)
    before = dict(zip(known, np.diag(covariance)[N_ERRORS::2], strict=True))
    after = dict(zip(craft.state.craters, np.diag(craft.state.covariance)[N_ERRORS::2], strict=True))
    assert all(after[crater] <= before[crater] * (1 + 1e-9) for crater in set(before) & set(after))


def test_craters_out_of_view_leave_the_state():
    craft, rng, _ = lander(7)
    around = Surroundings(CAMERA, MOUNTING, WORLD, 2.0, 5.0)
    craft = Lander(craft.state, NOISE, around)
    craft.sightings(sighted(WORLD, Pose(POSITION_M, MOUNTING), rng))
    first = craft.state
    # The view is as wide as 93 % of the altitude: half of it is new.
    moved = np.array([0.0, 650.0, 0.0])
    craft = Lander(dataclasses.replace(first, position_m=first.position_m + moved), NOISE, around)
    assert craft.sightings(sighted(WORLD, Pose(POSITION_M + moved, MOUNTING), rng)) is not None
    behind = first.craters[WORLD.centre_m[first.craters, 1] < POSITION_M[1] - 60]
    assert len(behind) > 20
    assert not np.isin(behind, craft.state.craters).any()
    assert np.isin(first.craters, craft.state.craters).sum() > 20


def test_an_outage_of_ten_seconds():
    _, normalised, status = flown(*lander(1), see=lambda t, seen: NOTHING if 8 <= t < 18 else seen)
    assert status[:8] == ["tracking"] * 8
    assert "tracking" not in status[8:18]
    assert status[18:] == ["tracking"] * 12
    assert normalised.max() < 40


def test_a_start_that_is_300_m_off_is_noticed():
    errors, _, status = flown(*lander(2, off_m=0.0, claimed_m=15.0, moved_m=300.0))
    wrong = np.linalg.norm(errors, axis=1) > 20
    # Whenever it is wrong it does not claim to track.
    assert not any(status[k] == "tracking" for k in np.flatnonzero(wrong))


def seen_from(t, shift_m, turn_deg):
    """Sightings of a camera that is shifted and turned against the true pose of a flight."""
    true = Pose(POSITION_M + VELOCITY_MPS * t, MOUNTING)
    wrong = true.changed(np.concatenate([shift_m, np.radians(turn_deg)]))
    return sighted(WORLD, wrong, np.random.default_rng(int(t)))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (([16.0, 0, 0], [0, 3.0, 0]), ([16.0, 0, 0], [0, 3.0, 0])),
        (([40.0, 0, 0], [0, 0, 0]), ([0.0, 50, 0], [0, 0, 0])),
    ],
    ids=["turned as no gyroscope can be", "two that differ"],
)
def test_wrong_fixes_do_not_replace_the_state(first, second):
    """A state is replaced by fixes that agree with each other and with the gyroscope only."""

    def see(t, seen):
        return seen_from(t, *(first if t == 10 else second)) if t in (10, 11) else seen

    errors, _, status = flown(*lander(8), see=see, seconds=16)
    assert np.linalg.norm(errors[9:], axis=1).max() < 6
    assert "tracking" not in status[10:12]
    assert status[13:] == ["tracking"] * 3


def test_half_of_the_sightings_false():
    def see(t, seen):
        rng = np.random.default_rng(int(t))
        n = len(seen)
        return Sightings(
            np.concatenate([seen.centre_px, rng.uniform(0, 256, (n, 2))]),
            np.concatenate([seen.radius_px, rng.permutation(seen.radius_px)]),
            np.concatenate([seen.score, seen.score]),
        )

    errors, normalised, status = flown(*lander(3), see=see)
    assert set(status[2:]) == {"tracking"}
    assert np.linalg.norm(errors[2:], axis=1).max() < 12
    assert normalised[2:].mean() < 14


def test_a_gap_of_the_inertial_unit_makes_the_state_uncertain():
    whole, gap = lander(4), lander(4)
    flown(*whole, see=lambda t, seen: seen if t < 5 else NOTHING, seconds=9)
    flown(*gap, see=lambda t, seen: seen if t < 5 else NOTHING, seconds=9, feel=lambda t: not 6 <= t < 8)
    sigma = [np.sqrt(np.trace(one[0].state.covariance[:3, :3])) for one in (whole, gap)]
    assert sigma[1] > 2 * sigma[0]
    assert np.isfinite(gap[0].state.covariance).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_senseless_measurements_change_nothing(value):
    craft, *_ = lander(5)
    before = craft.state
    assert not craft.range(value)
    assert not craft.range(-3.0)
    assert not craft.attitude(np.full((3, 3), value), np.full(3, 1e-4))
    craft.beam(Beam(np.array([0.3, 0.0, -0.95]), value, value), LidarErrors(0.05, 2.0, 0.2))
    craft.inertial(Increments.single(0.05, 0.05, np.full(3, value), np.zeros(3)))
    craft.inertial(Increments.single(-1.0, 0.05, np.zeros(3), np.zeros(3)))
    assert craft.state is before


STAR_SIGMAS_RAD = np.radians(np.array([10.0, 10.0, 60.0]) / 3600)


def with_stars(craft, rng):
    """Feed an attitude of a star tracker before each frame."""

    def see(t, seen):
        noise = STAR_SIGMAS_RAD * rng.normal(size=3)
        assert craft.attitude(matrix_from_rotation_vector(noise), STAR_SIGMAS_RAD)
        return seen

    return see


@pytest.mark.parametrize("turn_deg", [0.0, 0.15])
def test_a_star_tracker_and_an_unknown_mounting(turn_deg):
    """The mounting's error about each axis is estimated; with an exact mounting the attitude becomes more accurate."""
    turn = np.radians(turn_deg) * np.array([1.0, -1.0, 0.5])
    craft, rng, biases = lander(3, camera=CameraErrors(mounting_sigma_deg=0.1 if turn_deg else 0.0))
    mounting = matrix_from_rotation_vector(turn) @ MOUNTING
    errors, _, status = flown(craft, rng, biases, see=with_stars(craft, rng), mounting=mounting)
    assert set(status) == {"tracking"}
    state = craft.state
    sigma = np.sqrt(np.diag(state.covariance))
    np.testing.assert_allclose(state.mounting_rad, turn, atol=3.5 * sigma[21] + 1e-12)
    assert np.linalg.norm(errors[-1]) < 2.0
    # Without a star tracker the attitude is known to about 0.03 degrees.
    assert np.degrees(sigma[6:8]).max() < 0.01
    assert np.degrees(np.linalg.norm(rotation_vectors(state.rotation_site_from_body))) < 0.05


def test_time_tags_that_are_late():
    """The error of the position is along the velocity, and its stated size grows with the doubt about the time."""
    late_s, sigmas = 0.05, {}
    for sigma_s in (0.0, 0.05):
        craft, rng, biases = lander(4, camera=CameraErrors(time_tag_sigma_s=sigma_s))
        errors, _, status = flown(craft, rng, biases, late_s=late_s)
        assert set(status) == {"tracking"}
        along = VELOCITY_MPS / np.linalg.norm(VELOCITY_MPS)
        sigmas[sigma_s] = np.sqrt(along @ craft.state.covariance[:3, :3] @ along)
        last = errors[-1]
    # The last flight, which doubts its times.
    assert abs(last @ along) < 3 * sigmas[0.05]
    assert np.linalg.norm(last - along * (last @ along)) < 1.5
    assert sigmas[0.05] > 2 * sigmas[0.0]


def test_a_camera_that_is_mounted_upside_down_is_not_tracked_for_long():
    upside_down = np.diag([-1.0, -1.0, 1.0]) @ MOUNTING
    errors, _, status = flown(*lander(5), mounting=upside_down)
    wrong = np.linalg.norm(errors, axis=1) > 20
    assert not any(status[k] == "tracking" for k in np.flatnonzero(wrong))
    assert "lost" in status


def test_swapped_axes_of_the_gyroscope_are_noticed():
    craft, rng, biases = lander(4)
    inertial, turned = craft.inertial, np.radians([1.5, 0.0, 0.0])
    # The body does not turn, and the gyroscope reports a rate that belongs to another axis.
    craft.inertial = lambda one: inertial(
        dataclasses.replace(one, angular_rate_radps=one.angular_rate_radps + turned * np.sin(one.time_s[0]))
    )
    errors, _, status = flown(craft, rng, biases)
    wrong = np.linalg.norm(errors, axis=1) > 20
    assert not any(status[k] != "lost" for k in np.flatnonzero(wrong))
    assert "crater fixes" in craft.disagreeing


def test_beams_of_a_lidar_give_the_velocity():
    speeds = {}
    directions = np.array([[0.38, 0, -0.925], [-0.19, 0.33, -0.925], [-0.19, -0.33, -0.925]])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for with_lidar in (False, True):
        craft, rng, biases = lander(2)

        def see(t, seen, craft=craft, rng=rng, with_lidar=with_lidar):
            for direction in directions if with_lidar else ():
                end_m = (POSITION_M[2] + VELOCITY_MPS[2] * t) / -direction[2]
                beam = Beam(direction, VELOCITY_MPS @ direction + 0.02 * rng.normal(), end_m + 2 * rng.normal())
                craft.beam(beam, LidarErrors(0.02, 2.0, 1.0))
            return seen

        flown(craft, rng, biases, see=see, seconds=8)
        speeds[with_lidar] = np.sqrt(np.trace(craft.state.covariance[3:6, 3:6]))
        assert np.linalg.norm(craft.state.velocity_mps - VELOCITY_MPS) < 4 * speeds[with_lidar]
    assert speeds[True] < 0.7 * speeds[False]


def test_no_sightings_for_long_is_lost():
    _, _, status = flown(*lander(6), see=lambda t, seen: NOTHING, seconds=20)
    assert status[-1] == "lost"


def test_the_smoother_keeps_all_frames_and_ends_where_the_filter_ends():
    squared, filtered, smoothed = [], [], []
    for seed in range(2):
        plain = lander(seed)
        errors, _, _ = flown(*plain)
        craft, rng, biases = lander(seed)
        keeping = Lander(craft.state, NOISE, craft.surroundings, keep_poses=True)
        flown(keeping, rng, biases)
        state, at_end = keeping.state, plain[0].state
        assert len(state.past_position_m) == len(errors)
        np.testing.assert_allclose(state.position_m, at_end.position_m, atol=1e-6)
        np.testing.assert_allclose(state.covariance[:15, :15], at_end.covariance[:15, :15], rtol=1e-6, atol=1e-15)
        for k in range(len(errors)):
            error, covariance = state.past_pose_error(k, POSITION_M + VELOCITY_MPS * k, np.eye(3))
            squared.append(error @ np.linalg.solve(covariance, error))
            smoothed.append(error[:3])
        filtered.append(errors)
    assert np.sqrt(np.mean(np.square(smoothed))) < 0.7 * np.sqrt(np.mean(np.square(filtered)))
    assert 2.5 < np.mean(squared) < 9


def test_flights_together_are_those_one_by_one():
    """Measurements of three flights at the same times, with a gap; each flight misses others."""
    time_s, rng = 0.05 * np.arange(1, 101), np.random.default_rng(0)
    time_s = time_s[(time_s < 2.02) | (time_s > 2.53)]
    rate, force = 0.01 * rng.normal(size=(3, len(time_s), 3)), 0.02 * rng.normal(size=(3, len(time_s), 3))
    rate[:, 7] = np.nan
    force[..., 2] += 1.62
    frames, ranges = np.arange(5.0), np.arange(0.1, 5, 0.2)
    range_m = 1400 - 35 * ranges + rng.normal(size=(3, len(ranges)))
    range_m[0, 3] = range_m[1, 5:9] = np.nan
    attitudes = np.array([[matrix_from_rotation_vector(1e-4 * rng.normal(size=3)) for _ in frames] for _ in range(3)])
    attitudes[1, 2:] = np.nan
    direction = np.array([0.38, 0, -0.925]) / np.hypot(0.38, 0.925)
    speeds, slants = VELOCITY_MPS @ direction + 0.02 * rng.normal(size=(3, 5)), (1400 - 35 * frames) / 0.925 + 0.0
    speeds[2, 1:3] = np.nan
    lidars = [
        DopplerLidar(
            frames + 0.5,
            [Beam(direction, speed, slant - 17.5 if k else np.nan) for speed, slant in zip(own, slants, strict=True)],
            LidarErrors(0.02, 2.0, 1.0),
        )
        for k, own in enumerate(speeds.tolist())
    ]
    inertial = Increments(time_s, np.full(len(time_s), 0.05), rate, force)
    alone = [
        Instruments(
            dataclasses.replace(inertial, angular_rate_radps=rate[k], specific_force_mps2=force[k]),
            ranges,
            range_m[k],
            StarTracker(frames, attitudes[k], np.full(3, 1e-4)),
            lidars[k],
        )
        for k in range(3)
    ]
    seen = [
        [
            sighted(WORLD, Pose(POSITION_M + t * VELOCITY_MPS, MOUNTING), np.random.default_rng(int(10 * t) + k))
            for t in frames
        ]
        for k in range(3)
    ]
    flown = [list(fly(lander(k)[0], alone[k], frames, seen[k])) for k in range(3)]
    crafts = [lander(k)[0] for k in range(3)]
    found = list(fly_together(crafts, together(alone), frames, zip(*seen, strict=True)))
    assert len(found) == len(frames)
    for number, estimates in enumerate(found):
        for k, estimate in enumerate(estimates):
            expected = flown[k][number]
            assert (estimate.status, estimate.frame) == (expected.status, number)
            assert estimate.n_refused == expected.n_refused
            assert estimate.state.n_innovations == expected.state.n_innovations
            np.testing.assert_allclose(estimate.state.position_m, expected.state.position_m, atol=1e-7)
            np.testing.assert_allclose(estimate.state.covariance, expected.state.covariance, rtol=1e-5, atol=1e-9)
    assert "tracking" in {one.status for one in found[-1]}
    assert all(craft.state.time_s == ranges[-1] for craft in crafts)


def test_a_frame_before_the_state_is_skipped_with_its_sightings():
    craft, rng, _ = lander(9)
    true = Pose(POSITION_M, MOUNTING)
    frames = [NOTHING, sighted(WORLD, true, rng)]
    still = Increments(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    estimates = list(fly(craft, Instruments(still, np.zeros(0), np.zeros(0)), np.array([-1.0, 0.0]), frames))
    assert [estimate.frame for estimate in estimates] == [1]
    assert estimates[0].status == "tracking"
