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
    point_m: Array
    """Centres of the circles (N, 3), O_C."""
    pose: Pose
    """Pose of the camera."""
    camera: Camera
    """Intrinsics."""

    @property
    def depth_m(self) -> Array:
        """Depths of the centres (N,), O_C."""
        return self.point_m[:, 2]

    def jacobian(self, chosen: NDArray[np.integer] | None = None) -> Array:
        """Derivatives of centre and logarithm of radius by a step of the pose (K, 3, 6), of all craters or of some.

        The ellipse's own offset from the image of the circle's centre changes far more slowly.
        """
        x, y, z = (self.point_m if chosen is None else self.point_m[chosen]).T
        by_point = np.zeros((len(z), 3, 3))
        by_point[:, 0, 0], by_point[:, 0, 2] = self.camera.fx_px / z, -self.camera.fx_px * x / z**2
        by_point[:, 1, 1], by_point[:, 1, 2] = self.camera.fy_px / z, -self.camera.fy_px * y / z**2
        by_point[:, 2, 2] = -1 / z
        # X = R (c - p), and by a turn w from the left X moves by w x X.
        by_step = np.zeros((len(z), 3, 6))
        by_step[:, :, :3] = -self.pose.rotation_camera_from_site
        by_step[:, 0, 4], by_step[:, 0, 5] = z, -y
        by_step[:, 1, 3], by_step[:, 1, 5] = -z, x
        by_step[:, 2, 3], by_step[:, 2, 4] = y, -x
        return by_point @ by_step


def projected(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float = 0.0, least_radius_px: float = 1.0
) -> Projected:
    """Craters of a least radius whose centre is in the image or at most `margin_px` beside it."""
    index, points = _in_view(catalogue, camera, pose, margin_px, least_radius_px)
    normals = catalogue.normal[index] @ pose.rotation_camera_from_site.T
    centre, half = _boxes(camera, points, normals, catalogue.radius_m[index])
    seen = np.isfinite(half).all(axis=1)
    if not seen.all():
        index, points, centre, half = index[seen], points[seen], centre[seen], half[seen]
    return Projected(index, centre, np.sqrt(half[:, 0] * half[:, 1]), points, pose, camera)


def in_view(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float, least_radius_px: float
) -> NDArray[np.integer]:
    """Places of the craters whose centre is in the image or at most `margin_px` beside it, by radius over depth."""
    return _in_view(catalogue, camera, pose, margin_px, least_radius_px)[0]


def _in_view(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float, least_radius_px: float
) -> tuple[NDArray[np.integer], Array]:
    """As `in_view`, and the centres of the craters (N, 3), O_C."""
    axis = pose.rotation_camera_from_site[2]
    depth = catalogue.centre_m @ axis - pose.position_m @ axis
    # Size first: it alone excludes most craters of a catalogue.
    radius = catalogue.radius_m
    index = np.flatnonzero((depth > radius) & (camera.fx_px * radius >= least_radius_px * depth))
    points = camera_from_site(catalogue.centre_m[index], pose.position_m, pose.rotation_camera_from_site)
    x, y, depth = points.T
    x, y = camera.fx_px * x / depth + camera.cx_px, camera.fy_px * y / depth + camera.cy_px
    near = (x > -margin_px) & (x < camera.width_px + margin_px) & (y > -margin_px) & (y < camera.height_px + margin_px)
    return index[near], points[near]


def _boxes(camera: Camera, points: Array, normal: Array, radius_m: Array) -> tuple[Array, Array]:
    """Centres and half sizes (N, 2) of the boxes of circles, pixels, from their centres and normals (N, 3), O_C.

    NaN if the image of a circle is not an ellipse. Without distortion, from the dual conic r^2 (I - n n^T) - c c^T of
    the circle (Hartley & Zisserman, Multiple View Geometry, 2nd ed., section 8.1): its tangents along the axes of the
    image are the sides of the box. This is many times as fast as `project_circles`, which also has axes and directions.
    """
    if any(camera.distortion):
        boxes = project_circles(camera, points, normal, radius_m).bounding_boxes()
        return (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    focal_px, depth = np.array([camera.fx_px, camera.fy_px]), points[:, 2:]
    # Image coordinates relative to the image of the circle's centre: otherwise small, distant circles lose precision.
    middle = points[:, :2] / depth
    along = focal_px * (normal[:, :2] - middle * normal[:, 2:])
    own, mixed = focal_px**2 * (1 + middle**2) - along**2, -focal_px * middle - along * normal[:, 2:]
    radius = radius_m[:, None]
    last = radius**2 * (1 - normal[:, 2:] ** 2) - depth**2
    edge_on = np.abs(np.einsum("ij,ij->i", normal, points)) < 1e-9 * np.linalg.norm(points, axis=1)
    bad = (depth <= 0) | (last >= 0) | edge_on[:, None]
    last = np.where(bad, np.nan, last)
    centre = focal_px * middle + [camera.cx_px, camera.cy_px] + radius**2 * mixed / last
    return centre, radius * np.sqrt(radius**2 * mixed**2 - own * last) / -last
