"""A catalogue as a camera at a pose would see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_train.navigate.craters.catalogue import Catalogue


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and attitude of a camera."""

    position_m: Array
    """Position (3,), metres, O_L."""
    rotation_camera_from_site: Array
    """Attitude (3, 3)."""

    def changed(self, step: Array) -> "Pose":
        """The pose after a step (6,): shift in O_L, metres, then turn from the left, radians, O_C."""
        turn = matrix_from_rotation_vector(step[3:])
        return Pose(self.position_m + step[:3], turn @ self.rotation_camera_from_site)


@dataclass(frozen=True, slots=True)
class Projected:
    """The craters of a catalogue in view."""

    index: NDArray[np.integer]
    """Places (N,) in the catalogue."""
    centre_px: Array
    """Centres of the ellipses (N, 2), which are not the images of the circles' centres."""
    radius_px: Array
    """Radii (N,): half the geometric mean of width and height of the box."""
    depth_m: Array
    """Depths of the centres (N,), O_C."""
    jacobian: Array
    """Derivatives of centre and logarithm of radius by a step of the pose (N, 3, 6)."""


def projected(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float = 0.0, least_radius_px: float = 1.0
) -> Projected:
    """Craters of a least radius whose centre is in the image or at most `margin_px` beside it."""
    rotation = pose.rotation_camera_from_site
    index = in_view(catalogue, camera, pose, margin_px, least_radius_px)
    part = catalogue.part(index)
    points = camera_from_site(part.centre_m, pose.position_m, rotation)
    boxes = project_circles(camera, points, part.normal @ rotation.T, part.radius_m).bounding_boxes()
    seen = np.isfinite(boxes).all(axis=1)
    boxes, points, index = boxes[seen], points[seen], index[seen]
    radius = np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)) / 2
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    return Projected(index, centre, radius, points[:, 2], _jacobian(points, rotation, camera))


def in_view(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float, least_radius_px: float
) -> NDArray[np.integer]:
    """Places of the craters whose centre is in the image or at most `margin_px` beside it, by radius over depth."""
    points = camera_from_site(catalogue.centre_m, pose.position_m, pose.rotation_camera_from_site)
    depth = points[:, 2]
    ahead = depth > catalogue.radius_m
    safe = np.where(ahead, depth, 1.0)
    x, y = camera.fx_px * points[:, 0] / safe + camera.cx_px, camera.fy_px * points[:, 1] / safe + camera.cy_px
    near = (x > -margin_px) & (x < camera.width_px + margin_px) & (y > -margin_px) & (y < camera.height_px + margin_px)
    return np.flatnonzero(ahead & near & (camera.fx_px * catalogue.radius_m / safe >= least_radius_px))


def _jacobian(points: Array, rotation: Array, camera: Camera) -> Array:
    """Derivatives (N, 3, 6) of the images of points (N, 3), O_C; the ellipse's own offset changes far more slowly."""
    x, y, z = points.T
    zero = np.zeros_like(z)
    by_point = np.stack(
        [
            np.stack([camera.fx_px / z, zero, -camera.fx_px * x / z**2], axis=1),
            np.stack([zero, camera.fy_px / z, -camera.fy_px * y / z**2], axis=1),
            np.stack([zero, zero, -1 / z], axis=1),
        ],
        axis=1,
    )
    # X = R (c - p), and by a turn w from the left X moves by w x X.
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return np.concatenate([-by_point @ rotation, by_point @ cross], axis=2)
