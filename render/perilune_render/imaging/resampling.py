"""Resample the image of one camera to another camera at the same pose."""

from dataclasses import fields, replace
from functools import lru_cache

import cv2
import numpy as np

from perilune_render.imaging.radiance import Radiance
from perilune_shared.geometry.camera import Camera


def resample(image: np.ndarray, camera: Camera, source: Camera) -> np.ndarray:
    """Resample an image (h, w) of the camera `source` to `camera` (Lanczos, 8 x 8 px).

    If both cameras are equal, the image is returned unchanged. `source` must cover the view of `camera`. OpenCV rounds
    sample positions to 1/32 px. If the pixels of `source` are finer, several samples per pixel are averaged to avoid
    aliasing.
    """
    if camera == source:
        return image
    finer = max(1, int(np.ceil(source.fx_px / camera.fx_px - 0.01)))
    seen = cv2.remap(
        image, *_places(refined(camera, finer), source), cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
    )
    return seen if finer == 1 else cv2.resize(seen, (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)


def resample_nearest(image: np.ndarray, camera: Camera, source: Camera) -> np.ndarray:
    """Resample an image (h, w, ...) of `source` to `camera` by the pixel nearest to each pixel's centre."""
    if camera == source:
        return image
    x, y = _places(camera, source)
    column = np.clip(np.rint(x), 0, source.width_px - 1).astype(int)
    row = np.clip(np.rint(y), 0, source.height_px - 1).astype(int)
    return image[row, column]


def seen_by(radiance: Radiance, camera: Camera, source: Camera) -> Radiance:
    """A rendering of the camera `source`, resampled to `camera` by the nearest pixel."""
    if camera == source:
        return radiance
    images = {field.name: getattr(radiance, field.name) for field in fields(radiance)}
    seen = {name: resample_nearest(each, camera, source) for name, each in images.items() if each is not None}
    return replace(radiance, **seen)


def refined(camera: Camera, n: int) -> Camera:
    """A camera with the same view and each pixel divided into n x n pixels."""
    return replace(
        camera,
        width_px=n * camera.width_px,
        height_px=n * camera.height_px,
        fx_px=n * camera.fx_px,
        fy_px=n * camera.fy_px,
        cx_px=n * camera.cx_px,
        cy_px=n * camera.cy_px,
    )


@lru_cache(maxsize=4)
def _places(camera: Camera, source: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Column and row (h, w) float32 in `source` of each pixel centre of `camera`.

    As in OpenCV, the centre of the first pixel is at 0.
    """
    pixel = source.project(camera.rays(camera.pixel_centres())) - 0.5
    return pixel[..., 0].astype(np.float32), pixel[..., 1].astype(np.float32)
