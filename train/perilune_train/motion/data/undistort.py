"""Frames without lens distortion, which the navigators need."""

from dataclasses import replace

import cv2
import numpy as np

from perilune_shared.geometry.camera import NO_DISTORTION, Camera


def undistorted(images: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Resample 8-bit frames (n, height, width) to a camera without distortion and with the same focal length.

    Pixels that no ray of the frame reaches are 0. Without distortion, frames and camera are returned unchanged.
    """
    if not any(camera.distortion):
        return images, camera
    pinhole = replace(camera, distortion=NO_DISTORTION)
    # OpenCV's coordinates are 0 at the centre of the first pixel, ours at its outer corner.
    source = (camera.project(pinhole.rays(pinhole.pixel_centres())) - 0.5).astype(np.float32)
    source = source.reshape(camera.height_px, camera.width_px, 2)
    resampled = np.empty_like(images)
    for image, out in zip(images, resampled, strict=True):
        cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, out)
    return resampled, pinhole
