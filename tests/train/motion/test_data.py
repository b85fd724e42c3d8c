from dataclasses import replace

import cv2
import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import NO_DISTORTION, Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector
from perilune_train.data import frames
from perilune_train.data.shares import ALONE, Share
from perilune_train.motion.data import sequences
from perilune_train.motion.data.epochs import TrainingSequences
from perilune_train.motion.data.sequences import Jitter, mirrored, pair_sequence
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.data.undistort import undistorted
from perilune_train.motion.geometry import apply_homography, pixel_index_homography, plane_homography

PINNED_SEQUENCES = [(3, 0), (1, 2), (0, 4), (2, 3), (3, 2), (0, 1), (1, 2), (2, 1)]
"""Trajectory and first pair of the sequences of epoch 1 with seed 3."""


@pytest.fixture(scope="module")
def trajectories(dataset_nav):
    return load_trajectories(open_dataset(dataset_nav))


def _misfit(sequence, trajectory, pair):
    """Root mean square difference of the later frame, laid onto the earlier by the stated motion, in the middle."""
    down = -trajectory.rotation_camera_from_site[pair][:, 2]
    homography = plane_homography(
        trajectory.camera.matrix,
        sequence.translation_m[pair],
        sequence.rotation_c2_from_c1[pair],
        down,
        trajectory.position_m[pair, 2],
    )
    laid = cv2.warpPerspective(
        sequence.second[pair],
        pixel_index_homography(homography),
        sequence.second.shape[:0:-1],
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    middle = (slice(20, -20), slice(20, -20))
    return float(np.sqrt(np.mean((laid - sequence.first[pair])[middle] ** 2)))


def test_frames_of_a_distorting_lens_are_undistorted():
    """A pattern that depends on the direction of the ray only, seen by a distorting and by a plain camera."""
    bent = replace(Camera.from_field_of_view(96, 96, 50), distortion=(-0.12, 0.03, 0.001, -0.002, 0.0))
    plain = replace(bent, distortion=NO_DISTORTION)

    def seen(camera):
        rays = camera.rays(camera.pixel_centres())
        return np.rint(127 + 60 * np.sin(40 * rays[..., 0]) + 60 * np.cos(30 * rays[..., 1])).astype(np.uint8)

    (found,), camera = undistorted(seen(bent)[None], bent)
    assert camera == plain
    difference = np.abs(found.astype(int) - seen(plain))[4:-4, 4:-4]
    assert difference.max() <= 3
    assert np.abs(seen(bent).astype(int) - seen(plain)).max() > 20, "the distortion matters"
    images = seen(plain)[None]
    assert undistorted(images, plain)[0] is images


def test_a_camera_with_a_lens_model_is_refused(dataset_nav):
    dataset = open_dataset(dataset_nav)
    fisheye = dataset.info.camera.model_copy(update={"model": "equidistant"})
    dataset.info = dataset.info.model_copy(update={"camera": fisheye})
    with pytest.raises(UserError, match=r"camera\.model: got equidistant, expected pinhole, with or"):
        load_trajectories(dataset)


def test_trajectories_hold_poses_and_nominal_motion(trajectories):
    assert [d.split for d in trajectories] == ["train"] * 4 + ["val", "test"]
    d = trajectories[0]
    assert d.images.shape == (8, 96, 96) and d.images.dtype == np.uint8 and d.n_pairs == 7
    translation, rotation = d.nominal_motion
    np.testing.assert_allclose(rotation, np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-12)
    # The nominal trajectory sinks evenly from 1400 to 400 m, and the camera's z axis looks down.
    np.testing.assert_allclose(translation[:, 2], 1000 / 7)
    np.testing.assert_allclose(d.down_c, [0, 0, 1])
    assert np.abs(d.motion[0] - translation).max() < 40


def test_shrinking_keeps_the_rays(trajectories):
    small = trajectories[0].shrunk(32)
    assert small.images.shape[1:] == (32, 32)
    np.testing.assert_allclose(small.camera.rays([16.0, 4.0]), trajectories[0].camera.rays([48.0, 12.0]))


def test_warping_by_the_nominal_motion_brings_frames_together(trajectories):
    plain = pair_sequence(trajectories[0], 0, 7, warp=False)
    warped = pair_sequence(trajectories[0], 0, 7, warp=True)
    middle = (slice(None), slice(30, -30), slice(30, -30))

    def apart(s):
        return np.sqrt(np.mean((s.second - s.first)[middle] ** 2))

    assert apart(warped) < 0.8 * apart(plain)
    np.testing.assert_array_equal(warped.first, plain.first)


def test_the_stated_motion_lays_the_later_frame_onto_the_earlier(trajectories):
    d = trajectories[0]
    plain = pair_sequence(d, 0, 3, warp=False)
    wrong = pair_sequence(d, 0, 3, warp=False)
    wrong.translation_m[:, 0] += 60
    for pair in range(3):
        assert _misfit(plain, d, pair) < 0.5 * _misfit(wrong, d, pair)


def test_jitter_moves_image_and_truth_alike(trajectories, monkeypatch):
    d = trajectories[0]
    monkeypatch.setattr(sequences, "mirrored", lambda sequence, camera, rng: sequence)
    plain = pair_sequence(d, 0, 3, warp=False)
    moved = pair_sequence(d, 0, 3, warp=False, rng=np.random.default_rng(5), jitter=Jitter(np.full(3, 30.0), 0.01))
    assert np.linalg.norm(moved.translation_m - plain.translation_m, axis=1).min() > 5
    for pair in range(3):
        assert _misfit(moved, d, pair) < _misfit(plain, d, pair) + 0.15
        stale = replace(moved, translation_m=plain.translation_m, rotation_c2_from_c1=plain.rotation_c2_from_c1)
        assert _misfit(moved, d, pair) < 0.7 * _misfit(stale, d, pair)


def test_jitter_off_the_nominal_pose_is_wrong_by_a_few_hundredths_of_a_pixel():
    """The plane is nominal: error of the moved frame against the true plane (docstring of `pair_sequence`)."""
    rng, nominal_down = np.random.default_rng(0), np.array([0, 0, 1.0])
    camera = Camera.from_field_of_view(128, 128, 50.0).matrix
    places = np.stack(np.meshgrid(np.arange(4, 128, 8), np.arange(4, 128, 8)), axis=-1)
    wrong_px, moved_px = [], []
    for altitude_m in np.repeat(np.linspace(200, 1500, 14), 50):
        off_m, turn, tilt = 8 * rng.normal(size=(2, 3)), *np.radians(0.3) * rng.normal(size=(2, 3))
        down, true_m = matrix_from_rotation_vector(tilt) @ nominal_down, altitude_m + off_m[0, 2]
        t, r = np.array([20, 0, 30]) + off_m[1], matrix_from_rotation_vector(turn)
        new_t = t + 0.3 * 8 * rng.normal(size=3)
        new_r = matrix_from_rotation_vector(0.3 * np.radians(0.3) * rng.normal(size=3)) @ r
        old, new = (plane_homography(camera, *motion, down, true_m) for motion in ((t, r), (new_t, new_r)))
        change = plane_homography(camera, t, r, nominal_down, altitude_m) @ np.linalg.inv(
            plane_homography(camera, new_t, new_r, nominal_down, altitude_m)
        )
        shown, labelled, before = (apply_homography(h, places) for h in (np.linalg.inv(change) @ old, new, old))
        wrong_px.append(np.mean((shown - labelled) ** 2) * 2)
        moved_px.append(np.mean((labelled - before) ** 2) * 2)
    assert np.sqrt(np.mean(moved_px)) == pytest.approx(1.2, abs=0.1)
    assert np.sqrt(np.mean(wrong_px)) == pytest.approx(0.04, abs=0.01)


def test_mirrored_pairs_obey_the_mirrored_motion(trajectories):
    d = trajectories[0]
    plain = pair_sequence(d, 0, 2, warp=False)
    level = np.broadcast_to(np.eye(3), (2, 3, 3))
    # With an exactly level camera the ground's normal is the same in the mirror.
    flat = replace(d, rotation_camera_from_site=np.broadcast_to(d.nominal_rotation_camera_from_site, (8, 3, 3)))
    seen = set()
    for seed in range(30):
        found = mirrored(plain, d.camera, np.random.default_rng(seed))
        seen.add(tuple(np.round(found.translation_m[0], 6)))
        assert np.linalg.det(found.rotation_c2_from_c1[0]) == pytest.approx(1)
        assert _misfit(found, flat, 0) < 1.3 * _misfit(plain, flat, 0)
        still = replace(found, translation_m=plain.translation_m, rotation_c2_from_c1=level)
        turned = not np.allclose(found.translation_m, plain.translation_m)
        assert not turned or _misfit(found, flat, 0) < 0.9 * _misfit(still, flat, 0)
    assert len(seen) == 8


def test_residual_flow_is_zero_for_the_nominal_motion_and_a_shift_by_hand(trajectories):
    d = replace(
        trajectories[0],
        position_m=trajectories[0].nominal_position_m,
        rotation_camera_from_site=np.stack([trajectories[0].nominal_rotation_camera_from_site] * 8),
    )
    np.testing.assert_allclose(pair_sequence(d, 0, 3, warp=True).flow_px, 0, atol=1e-9)
    # 14 m more along x, seen from 1400 m: the ground moves back by 1 % of the focal length, in frame 1's pixels.
    beside = d.nominal_position_m + np.array([0, *[14] * 7])[:, None] * [1, 0, 0]
    flow = pair_sequence(replace(d, position_m=beside), 0, 1, warp=True).flow_px
    assert flow.shape == (1, 12, 12, 2)
    np.testing.assert_allclose(flow[0], np.broadcast_to([-0.01 * d.camera.fx_px, 0], (12, 12, 2)), atol=1e-9)


def test_flow_labels_of_a_mirrored_pair_are_the_mirrored_labels(trajectories):
    """Also where the camera is tilted by 20 degrees, so that the ground's normal changes in the mirror."""
    tilt = matrix_from_rotation_vector(np.radians([16.0, 12.0, 0.0]))
    d = trajectories[0]
    d = replace(
        d,
        rotation_camera_from_site=tilt @ d.rotation_camera_from_site,
        nominal_rotation_camera_from_site=tilt @ d.nominal_rotation_camera_from_site,
    )
    assert np.degrees(np.arccos(d.down_c[2])) == pytest.approx(20, abs=0.1)
    plain = pair_sequence(d, 0, 2, warp=True).flow_px
    seen = set()
    for seed in range(30):
        flips = tuple(np.random.default_rng(seed).random(3) < 0.5)
        if flips in seen:
            continue
        seen.add(flips)
        expected = plain
        if flips[0]:
            expected = expected[:, :, ::-1] * [-1, 1]
        if flips[1]:
            expected = expected[:, ::-1] * [1, -1]
        if flips[2]:
            expected = expected.transpose(0, 2, 1, 3)[..., ::-1]
        found = pair_sequence(d, 0, 2, warp=True, rng=np.random.default_rng(seed)).flow_px
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert len(seen) == 8


def sequences_of(trajectories, n_pairs=3, seed=3, share=ALONE):
    training = [d for d in trajectories if d.split == "train"]
    return TrainingSequences(training, n_pairs, warp=True, jitter=None, seed=seed, share=share)


def test_an_epoch_follows_from_seed_and_number_alone(trajectories):
    one, again, other = sequences_of(trajectories), sequences_of(trajectories), sequences_of(trajectories, seed=4)
    assert len(one.keys(0)) == one.fewest == 8  # 4 trajectories of 7 pairs: 2 sequences of 3 each
    assert one.keys(0) == again.keys(0)
    assert one.keys(0) != other.keys(0) and [key[1:] for key in one.keys(0)] != [key[1:] for key in one.keys(1)]
    key = one.keys(0)[2]
    one[one.keys(0)[1]]
    np.testing.assert_array_equal(one[key].second, again[key].second)
    # A run resumed with a later version sees the same sequences.
    assert one.keys(1) == [(1, place, *sequence) for place, sequence in enumerate(PINNED_SEQUENCES)]


@pytest.mark.parametrize("processes", [2, 3])
def test_processes_share_the_sequences_of_an_epoch(dataset_nav, trajectories, processes):
    whole = sequences_of(trajectories)
    shares = [Share(process, processes) for process in range(processes)]
    own = [sequences_of(load_trajectories(open_dataset(dataset_nav), share), share=share) for share in shares]
    assert sorted(key for one in own for key in one.keys(5)) == sorted(whole.keys(5))
    assert {one.fewest for one in own} == {min(len(one.keys(5)) for one in own)}
    for one in own:
        key = one.keys(5)[0]
        np.testing.assert_array_equal(one[key].second, whole[key].second)


def test_each_process_loads_the_frames_that_it_needs(dataset_nav, trajectories, monkeypatch):
    decoded, decode = [], frames.decode
    monkeypatch.setattr(frames, "decode", lambda *more: decoded.append(0) or decode(*more))
    loaded = [load_trajectories(open_dataset(dataset_nav), Share(process, 3)) for process in range(3)]
    # Training trajectories 0 and 3, 1, 2; each the one of val; the first process the one of test.
    assert [[len(d.images) for d in own] for own in loaded] == [
        [8, 0, 0, 8, 8, 8],
        [0, 8, 0, 0, 8, 0],
        [0, 0, 8, 0, 8, 0],
    ]
    assert len(decoded) == 8 * 8
    for own in loaded:
        for one, expected in zip(own, trajectories, strict=True):
            np.testing.assert_array_equal(one.position_m, expected.position_m)
            assert one.n_pairs == expected.n_pairs and one.shrunk(32).images.shape[1:] == (32, 32)
            if len(one.images):
                np.testing.assert_array_equal(one.images, expected.images)
    with pytest.raises(UserError, match="train trajectories: got 4, expected at least 5, one for each process"):
        load_trajectories(open_dataset(dataset_nav), Share(0, 5))


def test_a_detection_dataset_is_refused(dataset_detect):
    with pytest.raises(UserError, match="nav"):
        load_trajectories(open_dataset(dataset_detect))
