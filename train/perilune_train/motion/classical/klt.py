"""The classical baseline: corners tracked from frame to frame, and a robust motion fit over the ground plane.

1. Warp frame 2 onto frame 1 by the expected motion. The frames then have the same scale and a small shift.
2. Find corners in frame 1, track them into frame 2 and back, and drop tracks that do not return (`_tracks`): Lucas &
   Kanade 1981, with the pyramids of Bouguet 2001, as implemented in OpenCV.
3. Project the corners of frame 1 onto the ground plane at the estimated altitude.
4. Fit the motion by Gauss-Newton on the reprojection error, with Tukey's weights (Beaton & Tukey 1974, doi
   10.1080/00401706.1974.10489171) and a weak prior (`_fit`).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.data.frames import normalised
from perilune_train.motion.classical.estimate import EstimatedMotion, ExpectedMotion, GroundPlane
from perilune_train.motion.data.gyroscope import GyroscopeTurns
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.geometry import (
    apply_homography,
    pixel_index_homography,
    plane_homography,
)

_N_CORNERS = 600
_WINDOW_PX = 11
_CONSISTENCY_PX = 0.5
"""Largest distance, pixels, between the start of a track and its end after tracking back."""
_TUKEY = 4.685
NOMINAL_TURN_SIGMA_RAD = float(np.radians(0.5))
SHIFT_SHARE = 0.02
"""Standard deviations of a weak prior on the nominal motion: NOMINAL_TURN_SIGMA_RAD for the rotation, in radians, and
SHIFT_SHARE for shift / altitude. The prior is needed because few or clustered corners cannot separate tilt from
sideways shift, which look alike from above."""
_ITERATIONS = 15
_MIN_TRACKS = 8
_MEDIAN_OF_SIGMA = 1.1774
"""Median length of a vector with two normal components, divided by the standard deviation of one component."""


@dataclass(frozen=True, slots=True)
class Tracked:
    """Motion between two frames, estimated from tracks."""

    translation_m: Array
    """Motion (3,), O_C of frame 1."""
    rotation_c2_from_c1: Array
    """Rotation (3, 3)."""
    covariance: Array
    """Covariance (6, 6) of the turn, which multiplies from the left (radians), and the shift (metres, O_C of frame 2).
    It is the Cramer-Rao bound for these tracks if their errors are independent and the ground is a plane. The size of
    the errors is estimated from the residuals."""
    n_tracks: int
    """Number of consistent tracks."""


def klt_trajectory(trajectory: Trajectory, turns: GyroscopeTurns | None = None) -> EstimatedMotion:
    """Estimate the motions of a whole trajectory from images and, if given, a gyroscope.

    One pair of frames gives the translation only relative to the altitude. The altitude of the first frame is the true
    one; the estimated motions then update it. The attitude is assumed to be level.
    """
    nominal_translation, nominal_rotation_c2_from_c1 = trajectory.nominal_motion
    turn_sigma = np.full(trajectory.n_pairs, NOMINAL_TURN_SIGMA_RAD)
    if turns is not None:
        nominal_rotation_c2_from_c1, turn_sigma = turns.rotation_c2_from_c1, turns.sigma_rad
    images = stretched(trajectory.images)
    altitude_m = float(trajectory.position_m[0, 2])
    pairs = []
    for i in range(trajectory.n_pairs):
        expected = ExpectedMotion(nominal_translation[i], nominal_rotation_c2_from_c1[i], turn_sigma[i])
        plane = GroundPlane(trajectory.down_c, altitude_m)
        tracked = klt_motion(trajectory.camera, images[i], images[i + 1], expected, plane)
        altitude_m -= float(trajectory.down_c @ tracked.translation_m)
        pairs.append(tracked)
    motion = np.stack([pair.translation_m for pair in pairs]), np.stack([pair.rotation_c2_from_c1 for pair in pairs])
    return EstimatedMotion(motion, np.stack([pair.covariance for pair in pairs]))


def stretched(images: np.ndarray) -> np.ndarray:
    """Stretch frames (n, height, width) to equal mean and contrast, 8 bits.

    This is needed because OpenCV rejects windows of low contrast by a fixed threshold.
    """
    return np.clip(110 + 45 * normalised(images), 0, 255).astype(np.uint8)


def klt_motion(
    camera: Camera,
    image_1: np.ndarray,
    image_2: np.ndarray,
    expected: ExpectedMotion,
    plane: GroundPlane,
) -> Tracked:
    """Estimate the motion between two 8-bit images (height, width), over the ground plane below the first camera.

    If fewer than 8 corners can be tracked, returns the expected motion with the prior's covariance and 0 tracks.
    """
    homography = plane_homography(
        camera.matrix, expected.translation_m, expected.rotation_c2_from_c1, plane.down_c, plane.altitude_m
    )
    pixels_1, pixels_2 = _tracks(image_1, image_2, homography)
    if len(pixels_1) < _MIN_TRACKS:
        variance = np.square([expected.turn_sigma_rad] * 3 + [SHIFT_SHARE * plane.altitude_m] * 3)
        return Tracked(expected.translation_m, expected.rotation_c2_from_c1, np.diag(variance), 0)
    rays = camera.rays(pixels_1)
    points_c1 = rays * (plane.altitude_m / (rays @ plane.down_c))[:, None]
    return _fit(camera, points_c1, pixels_2, expected)


def _tracks(image_1: np.ndarray, image_2: np.ndarray, homography: Array) -> tuple[Array, Array]:
    """Corresponding points (N, 2) of both frames, in image coordinates."""
    size = image_1.shape[::-1]
    warp = {"flags": cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP}
    index_homography = pixel_index_homography(homography)
    warped = cv2.warpPerspective(image_2, index_homography, size, **warp)
    covered = cv2.warpPerspective(np.full_like(image_2, 255), index_homography, size, **warp)
    covered = cv2.erode(covered, np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8))
    corners = cv2.goodFeaturesToTrack(image_1, _N_CORNERS, 0.001, 5, mask=covered)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    window = (_WINDOW_PX, _WINDOW_PX)
    tracked, good, _ = cv2.calcOpticalFlowPyrLK(
        image_1, warped, corners, corners.copy(), winSize=window, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    back, good_back, _ = cv2.calcOpticalFlowPyrLK(
        warped, image_1, tracked, tracked.copy(), winSize=window, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    kept = (good & good_back).ravel().astype(bool)
    kept &= np.linalg.norm(back - corners, axis=-1).ravel() < _CONSISTENCY_PX
    pixels_1 = corners.reshape(-1, 2)[kept].astype(np.float64) + 0.5
    return pixels_1, apply_homography(homography, tracked.reshape(-1, 2)[kept].astype(np.float64) + 0.5)


def _fit(camera: Camera, points_c1: Array, pixels_2: Array, expected: ExpectedMotion) -> Tracked:
    """Fit the motion that maps points (N, 3), O_C of frame 1, to pixels (N, 2) of frame 2."""
    focal = np.array([camera.fx_px, camera.fy_px])
    weights = np.ones(len(points_c1))
    translation_m, rotation_c2_from_c1 = expected.translation_m, expected.rotation_c2_from_c1
    altitude_m = float(np.median(points_c1[:, 2]))
    prior = 1 / np.square([expected.turn_sigma_rad] * 3 + [SHIFT_SHARE * altitude_m] * 3)
    for _ in range(_ITERATIONS):
        points = (points_c1 - translation_m) @ rotation_c2_from_c1.T
        error = camera.project(points) - pixels_2
        distance = np.linalg.norm(error, axis=1)
        spread = max(1.4826 * float(np.median(distance)), 1e-3)
        weights = np.clip(1 - (distance / (_TUKEY * spread)) ** 2, 0, None) ** 2
        x, y, z = points.T
        zero = np.zeros_like(z)
        # Derivatives of the pixel with respect to the point in camera 2, then of this point with respect to a rotation
        # (from the left) and a shift.
        by_point = np.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], axis=1).reshape(-1, 2, 3)
        by_point *= focal[:, None]
        cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
        jacobian = np.concatenate([by_point @ cross, by_point], axis=2)
        weighted = jacobian * weights[:, None, None]
        normal = np.einsum("nij,nik->jk", weighted, jacobian)
        information = normal / (float(np.median(distance)) / _MEDIAN_OF_SIGMA) ** 2 + np.diag(prior)
        normal += np.diag(prior) * spread**2
        offset = np.concatenate(
            [
                rotation_vectors(rotation_c2_from_c1 @ expected.rotation_c2_from_c1.T),
                rotation_c2_from_c1 @ (expected.translation_m - translation_m),
            ]
        )
        # Metres and radians have very different scales; a unit diagonal keeps the system well conditioned.
        scale = 1 / np.sqrt(np.diag(normal))
        gradient = scale * (np.einsum("nij,ni->j", weighted, error) + prior * spread**2 * offset)
        step = -scale * np.linalg.lstsq(normal * np.outer(scale, scale), gradient, rcond=None)[0]
        turn = matrix_from_rotation_vector(step[:3])
        # X2' = T (R (X1 - t)) + s = T R (X1 - t'), with t' = t - (T R)^T s.
        rotation_c2_from_c1 = turn @ rotation_c2_from_c1
        translation_m = translation_m - rotation_c2_from_c1.T @ step[3:]
        if np.linalg.norm(step[:3]) < 1e-8 and np.linalg.norm(step[3:]) < 1e-5:
            break
    unit: Array = 1 / np.sqrt(np.diag(information))
    scale_of_each: Array = unit[:, None] * unit
    covariance = scale_of_each * np.linalg.inv(scale_of_each * information)
    return Tracked(translation_m, rotation_c2_from_c1, covariance, int((weights > 0).sum()))
