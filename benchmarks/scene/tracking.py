"""Residuals of tracked features between two rendered frames, from their depth and poses."""

import cv2
import numpy as np

from perilune_render.imaging.radiance import Radiance
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.frames import Array

_WINDOW_PX = 15
_N_FEATURES = 400


def klt_residuals_px(
    camera: Camera, before: Radiance, after: Radiance, pose_before: tuple[Array, Array], pose_after: tuple[Array, Array]
) -> Array:
    """Distances (N,), pixels, of features tracked by KLT from where depth and poses put them.

    A pose is a position (3,), O_L, metres, and a rotation_camera_from_site (3, 3). The search starts at the predicted
    place, so the residual is the change of the ground's appearance, noise of samples included.
    """
    brightest = np.percentile(before.radiance_factor, 99.5)
    grey = [np.clip(255 * frame.radiance_factor / brightest, 0, 255).astype(np.uint8) for frame in (before, after)]
    corner = cv2.goodFeaturesToTrack(grey[0], _N_FEATURES, 0.01, 4)[:, 0]
    column, row = corner.astype(int).T
    seen = camera.rays(corner + 0.5) * before.depth_m[row, column][:, None]
    expected = camera.project(camera_from_site(seen @ pose_before[1] + pose_before[0], *pose_after)) - 0.5
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        grey[0],
        grey[1],
        corner[:, None],
        expected.astype(np.float32)[:, None].copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=1,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    size = np.array([camera.width_px, camera.height_px])
    inside = (status[:, 0] == 1) & ((expected > _WINDOW_PX / 2) & (expected < size - _WINDOW_PX / 2)).all(axis=1)
    return np.linalg.norm(found[:, 0] - expected, axis=1)[inside]
