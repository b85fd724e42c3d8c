import numpy as np
import pytest
import torch

from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion import geometry


def _flight(rng, n=6):
    positions = np.array([0.0, 0, 900]) + rng.normal(size=(n, 3)) * [40, 40, 60]
    rotations = np.stack(
        [ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(0.05 * rng.normal(size=3)) for _ in range(n)]
    )
    return positions, rotations


def test_relative_pose_of_a_level_camera_by_hand():
    level = np.stack([ROTATION_CAMERA_FROM_BODY] * 2)
    translation, rotation = geometry.relative_poses([[0, 0, 100], [3, 10, 90]], level)
    # x_C = x_L, y_C = -y_L, z_C = -z_L: 10 m to the south are -10 along y_C, 10 m of sinking +10 along z_C.
    np.testing.assert_allclose(translation, [[3, -10, 10]])
    np.testing.assert_allclose(rotation, [np.eye(3)])


def test_relative_rotation_is_later_from_earlier():
    turn = matrix_from_rotation_vector([0, 0, 0.1])
    attitudes = np.stack([ROTATION_CAMERA_FROM_BODY, turn @ ROTATION_CAMERA_FROM_BODY])
    _, rotation = geometry.relative_poses(np.zeros((2, 3)), attitudes)
    np.testing.assert_allclose(rotation[0], turn, atol=1e-12)


def test_dead_reckoning_undoes_relative_poses():
    positions, rotations = _flight(np.random.default_rng(1))
    motions = geometry.relative_poses(positions, rotations)
    path, attitudes = geometry.dead_reckoning(positions[0], rotations[0], *motions)
    np.testing.assert_allclose(path, positions, atol=1e-9)
    np.testing.assert_allclose(attitudes, rotations, atol=1e-12)


def test_plane_homography_carries_projected_ground_points():
    camera = Camera(200, 160, 180.0, 170.0, 101.0, 79.0)
    rng = np.random.default_rng(2)
    positions, rotations = _flight(rng, 2)
    ground = np.column_stack([rng.uniform(-200, 200, (30, 2)), np.zeros(30)])
    pixels = [camera.project(camera_from_site(ground, p, r)) for p, r in zip(positions, rotations, strict=True)]
    (translation,), (rotation,) = geometry.relative_poses(positions, rotations)
    down = -rotations[0][:, 2]
    homography = geometry.plane_homography(camera.matrix, translation, rotation, down, positions[0, 2])
    np.testing.assert_allclose(geometry.apply_homography(homography, pixels[0]), pixels[1], atol=1e-8)


def test_pixel_index_homography_of_a_half_scale():
    # Image coordinate 1.0 (between the first two pixels' centres, index 0.5) goes to 0.5, the first centre, index 0.
    index = geometry.pixel_index_homography(np.diag([0.5, 0.5, 1.0]))
    np.testing.assert_allclose(geometry.apply_homography(index, [0.5, 0.5]), [0, 0], atol=1e-12)


def test_rotation_from_the_sixd_of_a_quarter_turn_by_hand():
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    # The six numbers are two columns. Lengths and skew are taken out: columns 3 x and 2 y + 5 x give the same rotation.
    stretched = torch.cat([3 * turn[:, 0], 2 * turn[:, 1] + 5 * turn[:, 0]])
    torch.testing.assert_close(geometry.rotation_from_sixd(stretched), turn)


def test_euler_angles_of_a_product_of_turns():
    expected = [0.1, -0.2, 0.3]
    x, y, z = (matrix_from_rotation_vector(a * np.eye(3)[i]) for i, a in enumerate(expected))
    np.testing.assert_allclose(geometry.euler_from_rotation(torch.from_numpy(z @ y @ x)), expected, atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 2.0])
def test_rotation_vectors_undo_the_matrix_even_when_tiny(size):
    vector = size * np.array([2, -1, 2]) / 3
    found = rotation_vectors(matrix_from_rotation_vector(vector))
    np.testing.assert_allclose(found, vector, rtol=1e-6, atol=1e-15)
