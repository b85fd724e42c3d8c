"""Homography of the ground plane from true poses, and images warped by it."""

import cv2
import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_train.motion.geometry import (
    apply_homography,
    pixel_index_homography,
    plane_homography,
    relative_poses,
)


def true_homography(
    camera: Camera,
    position_1_m: Array,
    rotation_1_camera_from_site: Array,
    position_2_m: Array,
    rotation_2_camera_from_site: Array,
) -> Array:
    """Homography (3, 3) of the ground plane from pixels of frame 1 to pixels of frame 2, from true poses.

    Takes positions (3,) in metres, O_L, and rotations (3, 3). The plane is the mean ground, z = 0 of O_L. The paper
    uses "the affine transformation matrix defined by groundtruth pose" without defining it. Deviation from the paper: a
    homography, which is exact on the plane; an affine map is not. Raises ValueError if the camera of frame 1 is not
    above the plane.
    """
    if position_1_m[2] <= 0:
        raise ValueError(f"altitude is {position_1_m[2]} m, not above 0")
    translation_m, rotation_c2_from_c1 = relative_poses(
        [position_1_m, position_2_m], [rotation_1_camera_from_site, rotation_2_camera_from_site]
    )
    down_c1 = -np.asarray(rotation_1_camera_from_site)[:, 2]
    return plane_homography(camera.matrix, translation_m[0], rotation_c2_from_c1[0], down_c1, float(position_1_m[2]))


def seen_in_second(shape: tuple[int, int], homography: Array) -> NDArray[np.bool_]:
    """Pixels (height, width) of frame 1 whose ground is also in frame 2; both frames have `shape`."""
    height, width = shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    moved = apply_homography(homography, np.stack([u, v], axis=-1))
    return ((moved >= 0) & (moved < [width, height])).all(axis=-1)


def moved_to_first(image_2: NDArray[np.floating] | NDArray[np.uint8], homography: Array) -> Array:
    """An image of frame 2 (height, width), resampled bilinearly at the pixels of frame 1.

    Outside the image, its edge pixels are repeated. `homography` (3, 3) maps pixels of frame 1 to pixels of frame 2.
    """
    height, width = image_2.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpPerspective(
        np.asarray(image_2, np.float32),
        pixel_index_homography(homography),
        (width, height),
        flags=flags,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(moved, np.float64)
