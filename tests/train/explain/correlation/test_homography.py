import cv2
import numpy as np
import pytest

from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_train.explain.correlation.homography import moved_to_first, seen_in_second, true_homography
from perilune_train.explain.correlation.pearson import pearson
from perilune_train.motion.data.trajectories import load_split
from perilune_train.motion.geometry import apply_homography

_TURN = matrix_from_quaternion([0.99, 0.05, -0.08, 0.1])


def test_the_homography_maps_projections_of_the_ground():
    camera = Camera(128, 96, 150, 140, 60, 50)
    first, second = np.array([0.0, 0, 1000]), np.array([50.0, -20, 800])
    tilted = ROTATION_CAMERA_FROM_BODY @ _TURN
    homography = true_homography(camera, first, ROTATION_CAMERA_FROM_BODY, second, tilted)
    points = np.column_stack([np.random.default_rng(0).uniform(-300, 300, (20, 2)), np.zeros(20)])
    before = camera.project(camera_from_site(points, first, ROTATION_CAMERA_FROM_BODY))
    after = camera.project(camera_from_site(points, second, tilted))
    np.testing.assert_allclose(apply_homography(homography, before), after, atol=1e-9)


def test_a_level_descent_is_a_scale_and_a_shift():
    camera = Camera(128, 128, 150, 150, 64, 64)
    level = ROTATION_CAMERA_FROM_BODY
    homography = true_homography(camera, np.array([0.0, 0, 1000]), level, np.array([50.0, -20, 800]), level)
    homography = homography / homography[2, 2]
    # Level views of a plane differ by the scale 1000 / 800 and a shift.
    np.testing.assert_allclose(homography[:2, :2], np.diag([1.25, 1.25]), atol=1e-9)
    np.testing.assert_allclose(homography[2], [0, 0, 1], atol=1e-12)


def test_below_the_ground_there_is_no_homography():
    camera, low = Camera(8, 8, 8, 8, 4, 4), np.array([0.0, 0, -1])
    with pytest.raises(ValueError, match="altitude"):
        true_homography(camera, low, ROTATION_CAMERA_FROM_BODY, low, ROTATION_CAMERA_FROM_BODY)


def test_warped_lower_images_correlate_with_upper_images(make_dataset, tmp_path):
    # Pixels of 4 m and less: the drawn ground has texels of 2 m, and larger pixels would alias.
    folder = make_dataset(tmp_path / "nav", "nav", side_px=256, splits={"train": 1, "val": 1, "test": 1}, scenes=1)
    trajectory = load_split(open_dataset(folder), "val")[0]
    position, rotation = trajectory.position_m, trajectory.rotation_camera_from_site
    moved, plain, swapped = [], [], []
    for i in range(trajectory.n_pairs):
        homography = true_homography(trajectory.camera, position[i], rotation[i], position[i + 1], rotation[i + 1])
        # In the last frame the noise of one grey level is a third of the contrast.
        upper, lower = (cv2.GaussianBlur(one, (0, 0), 1) for one in trajectory.images[i : i + 2].astype(np.float64))
        seen = seen_in_second(lower.shape, homography)
        moved.append(pearson(upper, moved_to_first(lower, homography), seen))
        plain.append(pearson(upper, lower, seen))
        inverse = np.linalg.inv(homography)
        swapped.append(pearson(upper, moved_to_first(lower, inverse), seen_in_second(lower.shape, inverse)))
        assert 0.3 < seen.mean() < 1
    assert min(moved) > 0.95
    assert max(plain) < 0.2 and max(swapped) < 0.2


def test_seen_pixels_are_those_inside_the_second_frame():
    image = np.arange(48.0).reshape(6, 8)
    homography = np.array([[1.0, 0, 3], [0, 1, -2], [0, 0, 1]])
    warped, seen = moved_to_first(image, homography), seen_in_second(image.shape, homography)
    # Pixel (row, column) of frame 1 is pixel (row - 2, column + 3) of frame 2.
    np.testing.assert_array_equal(warped[2:, :5], image[:4, 3:])
    np.testing.assert_array_equal(seen, np.outer([0, 0, 1, 1, 1, 1], [1, 1, 1, 1, 1, 0, 0, 0]).astype(bool))
