import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.classical.estimate import ExpectedMotion, GroundPlane
from perilune_train.motion.classical.klt import (
    NOMINAL_TURN_SIGMA_RAD,
    SHIFT_SHARE,
    _fit,
    klt_motion,
    klt_trajectory,
)
from perilune_train.motion.data.trajectories import load_trajectories
from perilune_train.motion.metrics.errors import motion_errors, summary


@pytest.fixture(scope="module")
def trajectories(make_dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("klt") / "nav"
    return load_trajectories(
        open_dataset(
            make_dataset(
                folder,
                "nav",
                side_px=160,
                n_frames=16,
                splits={"train": 1, "val": 1, "test": 1},
                scenes=1,
                craters=600,
                jitter_m=15.0,
            )
        )
    )


def _expected(translation_m, rotation):
    return ExpectedMotion(translation_m, rotation, NOMINAL_TURN_SIGMA_RAD)


def test_tracks_find_the_motion_far_better_than_the_nominal_curve(trajectories):
    found = summary(motion_errors(trajectories, [klt_trajectory(d).motion for d in trajectories]))
    nominal = summary(motion_errors(trajectories, [d.nominal_motion for d in trajectories]))
    assert found["position_rmse_vector_m"] < 0.5 * nominal["position_rmse_vector_m"]
    assert found["orientation_rmse_angle_deg"] < 0.3
    assert found["orientation_rmse_z_deg"] < 0.05


def test_a_featureless_ground_gives_the_nominal_motion(trajectories):
    d = trajectories[0]
    blank = np.full_like(d.images[0], 90)
    shift, turn = np.array([1.0, 2, 30]), np.eye(3)
    found = klt_motion(d.camera, blank, blank, _expected(shift, turn), GroundPlane(d.down_c, 800.0))
    assert found.n_tracks == 0
    np.testing.assert_array_equal(found.translation_m, shift)
    np.testing.assert_array_equal(found.rotation_c2_from_c1, turn)
    assert np.sqrt(found.covariance[3, 3]) > 10, "the nominal motion is known to metres only"


def test_without_motion_the_same_frame_gives_none(trajectories):
    d = trajectories[0]
    start = np.array([4.0, -3.0, 5.0])
    found = klt_motion(d.camera, d.images[0], d.images[0], _expected(start, np.eye(3)), GroundPlane(d.down_c, 1400.0))
    assert found.n_tracks > 30
    np.testing.assert_allclose(found.translation_m, 0, atol=1.0)
    np.testing.assert_allclose(found.rotation_c2_from_c1, np.eye(3), atol=1e-3)


def test_a_known_rotation_is_kept_and_makes_the_shift_better(trajectories):
    free, known = [], []
    for d in trajectories:
        plane, rotation = GroundPlane(d.down_c, float(d.position_m[0, 2])), d.motion[1][0]
        for k, sigma in ((free, NOMINAL_TURN_SIGMA_RAD), (known, 1e-6)):
            expected = ExpectedMotion(d.nominal_motion[0][0], rotation, sigma)
            found = klt_motion(d.camera, *d.images[:2], expected, plane)
            k.append(np.linalg.norm(found.translation_m - d.motion[0][0]))
            if k is known:
                np.testing.assert_allclose(found.rotation_c2_from_c1, rotation, atol=1e-5)
    assert np.mean(known) < 0.5 * np.mean(free)


def test_the_covariance_is_right_for_independent_errors_of_tracks():
    rng = np.random.default_rng(0)
    camera = Camera(256, 256, 275.0, 275.0, 128.0, 128.0)
    altitude_m, sigma_px, squares = 900.0, 0.1, []
    pixels = rng.uniform(5, 251, (400, 2))
    points = camera.rays(pixels) * altitude_m
    prior_sigmas = np.repeat([NOMINAL_TURN_SIGMA_RAD, SHIFT_SHARE * altitude_m], 3)
    for _ in range(200):
        turn, shift = rng.normal(size=3) * prior_sigmas[:3], rng.normal(size=3) * prior_sigmas[3:]
        rotation = matrix_from_rotation_vector(turn)
        seen = camera.project((points - shift) @ rotation.T) + sigma_px * rng.normal(size=pixels.shape)
        found = _fit(camera, points, seen, _expected(np.zeros(3), np.eye(3)))
        off = rotation_vectors(rotation @ found.rotation_c2_from_c1.T)
        error = np.concatenate([off, rotation @ (found.translation_m - shift)])
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(squares) == pytest.approx(6, rel=0.12)
