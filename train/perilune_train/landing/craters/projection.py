"""Project the craters of a catalogue into the image of a camera with a known pose."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import project_circles
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector
from perilune_train.compiled import compiled
from perilune_train.landing.craters.catalogue import Catalogue


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and attitude of a camera."""

    position_m: Array
    """Position (3,), metres, O_L."""
    rotation_camera_from_site: Array
    """Attitude (3, 3)."""

    def changed(self, step: Array) -> "Pose":
        """The pose after a step (6,): shift (metres, O_L), then rotation from the left (radians, O_C)."""
        turn = matrix_from_rotation_vector(step[3:])
        return Pose(self.position_m + step[:3], turn @ self.rotation_camera_from_site)


@dataclass(frozen=True, slots=True)
class Projected:
    """The craters of a catalogue in view."""

    index: NDArray[np.integer]
    """Rows (N,) of the catalogue."""
    centre_px: Array
    """Centres of the ellipses (N, 2), pixels; they differ from the images of the circles' centres."""
    radius_px: Array
    """Radii (N,), pixels: half the geometric mean of width and height of the bounding box."""
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
        """Derivatives (K, 3, 6) of centre and logarithm of the radius with respect to a pose step.

        K is the number of `chosen` craters, or of all craters. The offset between the centre of the ellipse and the
        image of the circle's centre is taken as constant, because it changes far more slowly than the centre.
        """
        points = self.point_m if chosen is None else self.point_m[chosen]
        return _derivatives(points, self.pose.rotation_camera_from_site, self.camera.fx_px, self.camera.fy_px)


@compiled
def _derivatives(point_m: Array, rotation_camera_from_site: Array, fx_px: float, fy_px: float) -> Array:
    """`Projected.jacobian` at points (K, 3), O_C.

    A point X = R (c - p) moves by -R times a shift of the camera, and by w x X when it turns by w (R is multiplied
    from the left).
    """
    derivatives = np.empty((len(point_m), 3, 6))
    for k in range(len(point_m)):
        x, y, z = point_m[k]
        right, down = fx_px / z, fy_px / z
        by_step = derivatives[k]
        for axis in range(3):
            by_step[0, axis] = right * (rotation_camera_from_site[2, axis] * x / z - rotation_camera_from_site[0, axis])
            by_step[1, axis] = down * (rotation_camera_from_site[2, axis] * y / z - rotation_camera_from_site[1, axis])
            by_step[2, axis] = rotation_camera_from_site[2, axis] / z
        by_step[0, 3], by_step[0, 4], by_step[0, 5] = -right * x * y / z, right * (z + x * x / z), -right * y
        by_step[1, 3], by_step[1, 4], by_step[1, 5] = -down * (z + y * y / z), down * x * y / z, down * x
        by_step[2, 3], by_step[2, 4], by_step[2, 5] = -y / z, x / z, 0.0
    return derivatives


def projected(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float = 0.0, least_radius_px: float = 1.0
) -> Projected:
    """Project the craters that `in_view` selects, except circles whose image is not an ellipse."""
    index, points = _in_view(catalogue, camera, pose, margin_px, least_radius_px)
    rotation_camera_from_site = pose.rotation_camera_from_site
    if any(camera.distortion):
        normals = catalogue.normal[index] @ rotation_camera_from_site.T
        boxes = project_circles(camera, points, normals, catalogue.radius_m[index]).bounding_boxes()
        centre, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    else:
        centre, half = _boxes(
            points, index, catalogue.normal, catalogue.radius_m, rotation_camera_from_site, _lens(camera)
        )
    seen = np.isfinite(half).all(axis=1)
    if not seen.all():
        index, points, centre, half = index[seen], points[seen], centre[seen], half[seen]
    return Projected(index, centre, np.sqrt(half[:, 0] * half[:, 1]), points, pose, camera)


def in_view(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float, least_radius_px: float
) -> NDArray[np.integer]:
    """Rows of the craters in view.

    The centre of a crater in view is in the image or at most `margin_px` outside it. The radius, times focal length
    over depth, is at least `least_radius_px`.
    """
    return _in_view(catalogue, camera, pose, margin_px, least_radius_px)[0]


def _in_view(
    catalogue: Catalogue, camera: Camera, pose: Pose, margin_px: float, least_radius_px: float
) -> tuple[NDArray[np.integer], Array]:
    """The rows as `in_view` returns them, and the centres of these craters (N, 3), O_C."""
    limits = margin_px, least_radius_px
    rotation_camera_from_site = pose.rotation_camera_from_site
    return _visible(
        catalogue.centre_m, catalogue.radius_m, pose.position_m, rotation_camera_from_site, _lens(camera), limits
    )


_Lens = tuple[float, float, float, float, float, float]
"""Focal lengths, principal point and size of the image of a pinhole, pixels."""


def _lens(camera: Camera) -> _Lens:
    if camera.model != "pinhole":
        raise UserError("landing", "camera.model", camera.model, "pinhole: the filter uses no lens models")
    width, height = float(camera.width_px), float(camera.height_px)
    return camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, width, height


@compiled
def _visible(
    centre_m: Array,
    radius_m: Array,
    position_m: Array,
    rotation_camera_from_site: Array,
    lens: _Lens,
    limits: tuple[float, float],
) -> tuple[NDArray[np.int64], Array]:
    """`_in_view` for circles with centres (N, 3), O_L, and radii (N,).

    `limits` are `margin_px` and `least_radius_px`.
    """
    fx_px, fy_px, cx_px, cy_px, width_px, height_px = lens
    margin_px, least_px = limits
    # No branches: the processor cannot predict which craters pass. Size comes first, because it alone excludes most
    # craters of a catalogue.
    index = np.empty(len(radius_m) + 1, np.int64)
    large = 0
    for k in range(len(radius_m)):
        x, y, z = centre_m[k, 0] - position_m[0], centre_m[k, 1] - position_m[1], centre_m[k, 2] - position_m[2]
        depth = (
            rotation_camera_from_site[2, 0] * x
            + rotation_camera_from_site[2, 1] * y
            + rotation_camera_from_site[2, 2] * z
        )
        index[large] = k
        large += (depth > radius_m[k]) & (fx_px * radius_m[k] >= least_px * depth)
    count = 0
    for number in range(large):
        k = index[number]
        across, down, depth = _in_camera(centre_m[k], position_m, rotation_camera_from_site)
        column, row = fx_px * across / depth + cx_px, fy_px * down / depth + cy_px
        index[count] = k
        near = (column > -margin_px) & (column < width_px + margin_px)
        count += near & (row > -margin_px) & (row < height_px + margin_px)
    index, points = index[:count].copy(), np.empty((count, 3))
    for number in range(count):
        points[number] = _in_camera(centre_m[index[number]], position_m, rotation_camera_from_site)
    return index, points


@compiled
def _in_camera(point_m: Array, position_m: Array, rotation_camera_from_site: Array) -> tuple[float, float, float]:
    """Transform a point (3,) from O_L to O_C."""
    x, y, z = point_m[0] - position_m[0], point_m[1] - position_m[1], point_m[2] - position_m[2]
    return (
        rotation_camera_from_site[0, 0] * x + rotation_camera_from_site[0, 1] * y + rotation_camera_from_site[0, 2] * z,
        rotation_camera_from_site[1, 0] * x + rotation_camera_from_site[1, 1] * y + rotation_camera_from_site[1, 2] * z,
        rotation_camera_from_site[2, 0] * x + rotation_camera_from_site[2, 1] * y + rotation_camera_from_site[2, 2] * z,
    )


@compiled
def _boxes(
    points: Array,
    index: NDArray[np.integer],
    normals: Array,
    radius_m: Array,
    rotation_camera_from_site: Array,
    lens: _Lens,
) -> tuple[Array, Array]:
    """Centres and half sizes (K, 2), pixels, of the boxes of circles, for a pinhole.

    `points` (K, 3), O_C, are the centres of the circles and `index` (K,) their rows in the catalogue, which has
    `normals` (N, 3), O_L, and `radius_m` (N,). NaN if the image of a circle is not an ellipse.

    The dual conic of the circle is r^2 (I - n n^T) - c c^T (Hartley & Zisserman, Multiple View Geometry, 2nd ed.,
    section 8.1); its tangents along the axes of the image are the sides of the box. This is many times as fast as
    `project_circles`, which also computes axes and directions.
    """
    focal_px, middle_px = lens[:2], lens[2:4]
    centre, half = np.full((len(points), 2), np.nan), np.full((len(points), 2), np.nan)
    normal = np.empty(3)
    for k in range(len(points)):
        x, y, depth = points[k]
        for axis in range(3):
            normal[axis] = 0.0
            for i in range(3):
                normal[axis] += rotation_camera_from_site[axis, i] * normals[index[k], i]
        squared = radius_m[index[k]] ** 2
        last = squared * (1 - normal[2] ** 2) - depth**2
        distance = np.sqrt(x * x + y * y + depth * depth)
        edge_on = abs(normal[0] * x + normal[1] * y + normal[2] * depth) < 1e-9 * distance
        if depth <= 0 or last >= 0 or edge_on:
            continue
        for axis in range(2):
            # Compute relative to the image of the circle's centre: otherwise small, distant circles lose precision.
            middle = points[k, axis] / depth
            along = focal_px[axis] * (normal[axis] - middle * normal[2])
            quadratic = focal_px[axis] ** 2 * (1 + middle**2) - along**2
            mixed = -focal_px[axis] * middle - along * normal[2]
            centre[k, axis] = focal_px[axis] * middle + middle_px[axis] + squared * mixed / last
            half[k, axis] = np.sqrt(squared * (squared * mixed**2 - quadratic * last)) / -last
    return centre, half
