"""Relative poses of a moving camera, homographies of the ground plane, and dead reckoning.

O_L is the frame of the landing site, O_C the frame of the camera (perilune_shared.geometry.frames).

The motion from frame 1 to frame 2 is given in O_C of frame 1: `translation_m` = R1 (p2 - p1) and
`rotation_c2_from_c1` = R2 R1^T, with R = rotation_camera_from_site and p = position_m in O_L.
A point X1 in O_C of frame 1 has the coordinates X2 = rotation_c2_from_c1 (X1 - translation_m) in O_C of frame 2.
"""

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from perilune_shared.geometry.frames import Array


def relative_poses(position_m: ArrayLike, rotation_camera_from_site: ArrayLike) -> tuple[Array, Array]:
    """Motions between consecutive frames of one trajectory.

    Takes positions (n, 3) in metres, O_L, and rotations (n, 3, 3); returns translation_m (n - 1, 3) in O_C of the
    earlier frame and rotation_c2_from_c1 (n - 1, 3, 3).
    """
    p, r = np.asarray(position_m, np.float64), np.asarray(rotation_camera_from_site, np.float64)
    return np.einsum("nij,nj->ni", r[:-1], np.diff(p, axis=0)), r[1:] @ np.swapaxes(r[:-1], 1, 2)


def dead_reckoning(
    start_position_m: ArrayLike,
    start_rotation_camera_from_site: ArrayLike,
    translation_m: ArrayLike,
    rotation_c2_from_c1: ArrayLike,
) -> tuple[Array, Array]:
    """Positions (n + 1, 3) in O_L and rotations (n + 1, 3, 3) from a known start and n motions."""
    positions = [np.asarray(start_position_m, np.float64)]
    rotations = [np.asarray(start_rotation_camera_from_site, np.float64)]
    for t, r in zip(np.asarray(translation_m), np.asarray(rotation_c2_from_c1), strict=True):
        positions.append(positions[-1] + rotations[-1].T @ t)
        rotations.append(r @ rotations[-1])
    return np.stack(positions), np.stack(rotations)


def plane_homography(
    camera_matrix: ArrayLike,
    translation_m: ArrayLike,
    rotation_c2_from_c1: ArrayLike,
    plane_normal_c1: ArrayLike,
    plane_distance_m: float,
) -> Array:
    """Homography (3, 3) of a plane, from image coordinates of frame 1 to image coordinates of frame 2.

    The plane contains all points X1 with plane_normal_c1 . X1 = plane_distance_m. For the ground, the normal is the
    downward unit vector in O_C of frame 1, and the distance is the altitude. H = K R (I - t n^T / d) K^-1 (Hartley &
    Zisserman, 2nd ed., section 13.1).
    """
    k, t, n = (np.asarray(values, np.float64) for values in (camera_matrix, translation_m, plane_normal_c1))
    induced = np.eye(3) - np.outer(t, n) / plane_distance_m
    return k @ np.asarray(rotation_c2_from_c1) @ induced @ np.linalg.inv(k)


def ground_homography(camera_matrix: ArrayLike, position_m: ArrayLike, rotation_camera_from_site: ArrayLike) -> Array:
    """Homographies (n, 3, 3) from points (x, y, 1) of the ground plane to image coordinates.

    x and y are in metres; the plane is z = 0 in O_L. A camera at p = position_m (n, 3) with
    R = rotation_camera_from_site (n, 3, 3) sees a point X at R (X - p) in O_C.
    """
    p, r = np.asarray(position_m, np.float64), np.asarray(rotation_camera_from_site, np.float64)
    offset = -np.einsum("nij,nj->ni", r, p)
    return np.asarray(camera_matrix, np.float64) @ np.concatenate([r[:, :, :2], offset[:, :, None]], axis=2)


def pixel_index_homography(homography: ArrayLike) -> Array:
    """Convert a homography (3, 3) to OpenCV's coordinates: the centre of the first pixel is at 0 instead of 0.5."""
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    return np.linalg.inv(shift) @ np.asarray(homography) @ shift


def apply_homography(homography: ArrayLike, points_px: ArrayLike) -> Array:
    """Apply a homography to image points (..., 2)."""
    p, h = np.asarray(points_px, np.float64), np.asarray(homography, np.float64)
    q = np.concatenate([p, np.ones_like(p[..., :1])], axis=-1) @ h.T
    return q[..., :2] / q[..., 2:]


def rotation_from_sixd(sixd: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) from the continuous representation (..., 6).

    The six numbers are the matrix's first two columns before orthonormalisation (Zhou et al. 2019,
    doi 10.1109/CVPR.2019.00589, equation 15).
    """
    a, b = sixd[..., :3], sixd[..., 3:]
    x = functional.normalize(a, dim=-1)
    y = functional.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def euler_from_rotation(rotation: Tensor) -> Tensor:
    """Euler angles (..., 3) about x, y, z, in radians, of rotations (..., 3, 3) = Rz Ry Rx.

    The angle about y must be between -90 and 90 degrees.
    """
    cos_y = torch.hypot(rotation[..., 0, 0], rotation[..., 1, 0])
    return torch.stack(
        [
            torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2]),
            torch.atan2(-rotation[..., 2, 0], cos_y),
            torch.atan2(rotation[..., 1, 0], rotation[..., 0, 0]),
        ],
        dim=-1,
    )


def mean_rotation(rotations: Array) -> Array:
    """Rotation (3, 3) nearest to the mean of rotations (n, 3, 3) (Moakher 2002, doi 10.1137/S0895479801383877)."""
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
