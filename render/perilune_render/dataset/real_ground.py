"""Measure the share of a frame that shows real ground, and draw the outline of the elevation model."""

import cv2
import numpy as np

from perilune_render.terrain.elevation.model import ElevationModel
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.frames import Array, site_from_selenographic

_POINTS_PER_SIDE = 200
_OUTLINE = (230, 190, 60)
"""Colour of the outline, BGR."""


def real_ground_share(
    scene: Scene, camera: Camera, position_m: Array, rotation_camera_from_site: Array, depth_m: np.ndarray
) -> float:
    """Share of a frame's ground pixels that show ground from the elevation model; 0 if no pixel shows ground.

    `depth_m` (h, w) is the depth as in `Camera.points`, infinite where a pixel shows no ground.
    """
    hit = np.isfinite(depth_m)
    if not hit.any() or not scene.real.any():
        return 0.0
    seen = camera.points(camera.pixel_centres()[hit], depth_m[hit])
    ground = seen @ rotation_camera_from_site + position_m
    return float((value_at(scene.real, scene.grid, ground[:, 0], ground[:, 1]) > 0.5).mean())


def outline_m(model: ElevationModel) -> Array:
    """Points (N, 2) on the edge of an elevation model's raster: x and y in O_L, metres.

    Points without a finite position are left out.
    """
    rows, columns = model.height_m.shape
    along, zero = np.linspace(0, 1, _POINTS_PER_SIDE, endpoint=False), np.zeros(_POINTS_PER_SIDE)
    column = np.concatenate([along, zero + 1, 1 - along, zero]) * columns
    row = np.concatenate([zero, along, zero + 1, 1 - along]) * rows
    latitude, longitude = model.raster.selenographic(column, row)
    x, y = site_from_selenographic(latitude, longitude, model.latitude_deg, model.longitude_deg)
    points = np.stack([x, y], axis=-1)
    return points[np.isfinite(points).all(axis=1)]


def draw_outline(
    picture: np.ndarray,
    outline: Array,
    scene: Scene,
    camera: Camera,
    position_m: Array,
    rotation_camera_from_site: Array,
) -> None:
    """Draw an elevation model's outline (N, 2) on a colour picture of a frame, in place.

    The picture may be enlarged by an integer factor.
    """
    scale = picture.shape[1] / camera.width_px
    height = value_at(scene.height_m.astype(np.float64), scene.grid, outline[:, 0], outline[:, 1])
    pixels = camera.project(camera_from_site(np.column_stack([outline, height]), position_m, rotation_camera_from_site))
    for first, second in zip(pixels, np.roll(pixels, -1, axis=0), strict=True):
        ends = np.array([first, second]) * scale
        if np.isfinite(ends).all() and (np.abs(ends) < 1e4).all():
            (a, b), (c, d) = np.rint(ends).astype(int).tolist()
            cv2.line(picture, (a, b), (c, d), _OUTLINE, 1, cv2.LINE_AA)
