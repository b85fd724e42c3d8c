"""Compiled loops over craters and pixels: selection, visible share, sunlit share, contrast, index."""

import math
from typing import NamedTuple

import numpy as np

from perilune_render.provenance.kernels import njit
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.ellipse import Ellipses
from perilune_shared.geometry.frames import Array
from perilune_shared.labels.masks import SLACK_PX, SLACK_RADII

REACH = 1.5
"""Radius of the disc in which contrast is measured, in radii of the rim."""
N_FITTED = 4
"""Number of fitted values of a crater's shading."""
_SLACK = 0.99
"""Factor on the smallest radius in `centred_in`, since rounding differs in the ellipses that are computed later."""


class Circles(NamedTuple):
    """N circles, as an argument of compiled functions."""

    centre_m: Array
    """Centres, metres (N, 3)."""
    normal: Array
    """Unit normals of their planes (N, 3)."""
    radius_m: Array
    """Radii, metres (N,)."""


class Pinhole(NamedTuple):
    """A camera without distortion, as an argument of compiled functions; all values in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


def pinhole_of(camera: Camera) -> Pinhole:
    return Pinhole(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px)


def centred_in(
    camera: Camera, position_m: Array, rotation_camera_from_site: Array, circles: Circles, least_px: float
) -> tuple[np.ndarray, Array]:
    """Select the circles in O_L with their centre in the image and a large enough radius there.

    `camera` has no distortion. The radius, sqrt(a b) of the ellipse, must be at least `least_px`, pixels; some circles
    with a slightly smaller radius are also selected. Returns the indices of the selected circles (M,) and their centres
    in O_C (M, 3), metres.

    The centres and pixels equal the results of `camera_from_site`, `Camera.project` and `Camera.inside` to the bit. One
    loop computes them, since a scene has far more craters than an image shows.
    """
    pose = np.asarray(position_m, np.float64), np.ascontiguousarray(rotation_camera_from_site, np.float64)
    return _centred_in(circles, *pose, pinhole_of(camera), least_px)


@njit(error_model="numpy")
def _centred_in(circles, position, rotation, pinhole, least):
    (centre, normal, radius), (fx, fy, cx, cy, width, height) = circles, pinhole
    rows, in_camera = np.empty(len(centre), np.int64), np.empty((len(centre), 3))
    count = 0
    for k in range(len(centre)):
        dx, dy, dz = centre[k, 0] - position[0], centre[k, 1] - position[1], centre[k, 2] - position[2]
        z = dx * rotation[2, 0] + dy * rotation[2, 1] + dz * rotation[2, 2]
        if z > 0 and fx * radius[k] / max(z, 1e-9) > 0.5 * least:
            x = dx * rotation[0, 0] + dy * rotation[0, 1] + dz * rotation[0, 2]
            y = dx * rotation[1, 0] + dy * rotation[1, 1] + dz * rotation[1, 2]
            u, v = fx * (x / z) + cx, fy * (y / z) + cy
            if 0 <= u < width and 0 <= v < height:
                # a b = fx fy r^2 |n c| / (z^2 - r^2 (1 - n_z^2))^1.5, here compared by its square.
                along = normal[k, 0] * dx + normal[k, 1] * dy + normal[k, 2] * dz
                n_z = normal[k, 0] * rotation[2, 0] + normal[k, 1] * rotation[2, 1] + normal[k, 2] * rotation[2, 2]
                depth_2 = z * z - radius[k] ** 2 * (1 - n_z * n_z)
                if (fx * fy * radius[k] ** 2 * along) ** 2 >= (_SLACK * least) ** 4 * depth_2**3:
                    rows[count], in_camera[count, 0], in_camera[count, 1], in_camera[count, 2] = k, x, y, z
                    count += 1
    return rows[:count].copy(), in_camera[:count].copy()


@njit()
def floored(x):
    """The largest integer up to x. On a CUDA device, `math.floor` returns a float, and there is no `np.floor`."""
    return int(math.floor(x))  # noqa: RUF046


class Rims(NamedTuple):
    """N circles in O_L, as an argument of compiled functions.

    The points of a circle are c + r (cos t p + sin t q) at M angles t.
    """

    centre_m: Array
    """Centres, metres (N, 3)."""
    p: Array
    """Unit vectors in the planes of the circles (N, 3)."""
    q: Array
    """Unit vectors in the planes, normal to `p` (N, 3)."""
    radius_m: Array
    """Radii, metres (N,)."""
    cos: Array
    """Cosines of the angles (M,)."""
    sin: Array
    """Sines of the angles (M,)."""


def rim_shares(
    rims: Rims, camera: Camera, position_m: Array, rotation_camera_from_site: Array, depth: np.ndarray
) -> Array:
    """Share (N,) of each rim's points that are inside the image and not hidden by the ground.

    `camera` has no distortion; `depth` (h, w), metres, is the depth of its image along the axis. The result equals the
    result of `rim_points`, `camera_from_site`, `Camera.project` and `Camera.inside` to the bit.
    """
    pose = np.asarray(position_m, np.float64), np.ascontiguousarray(rotation_camera_from_site, np.float64)
    return _rim_shares(rims, *pose, pinhole_of(camera), depth)


@njit()
def _rim_shares(rims, position, rotation, pinhole, depth):
    shares = np.empty(len(rims.radius_m))
    for k in range(len(shares)):
        shares[k] = rim_share(rims, k, position, rotation, pinhole, depth)
    return shares


@njit()
def rim_share(rims, k, position, rotation, pinhole, depth):
    """Share of the points of rim k, as `rim_shares`."""
    fx, fy, cx, cy, width, height = pinhole
    centre, p, q, radius = rims.centre_m[k], rims.p[k], rims.q[k], rims.radius_m[k]
    slack, shown = 0.0, 0
    for m in range(len(rims.cos)):
        cos, sin = rims.cos[m], rims.sin[m]
        dx = centre[0] + radius * (cos * p[0] + sin * q[0]) - position[0]
        dy = centre[1] + radius * (cos * p[1] + sin * q[1]) - position[1]
        dz = centre[2] + radius * (cos * p[2] + sin * q[2]) - position[2]
        z = dx * rotation[2, 0] + dy * rotation[2, 1] + dz * rotation[2, 2]
        if m == 0:
            slack = max(SLACK_RADII * radius, SLACK_PX * z / fx)
        if z > 0:
            x = dx * rotation[0, 0] + dy * rotation[0, 1] + dz * rotation[0, 2]
            y = dx * rotation[1, 0] + dy * rotation[1, 1] + dz * rotation[1, 2]
            u, v = fx * (x / z) + cx, fy * (y / z) + cy
            if 0 <= u < width and 0 <= v < height:
                ground_z = depth[int(v), int(u)]
                if math.isfinite(ground_z) and z <= ground_z + slack:
                    shown += 1
    return shown / len(rims.cos)


def sunlit_fractions(ellipses: Ellipses, sunlit: np.ndarray) -> Array:
    """Sunlit share (N,) of the pixels with their centre in each of N ellipses; `sunlit` is (h, w) bool.

    The share is 0 if an ellipse contains no pixel centre.
    """
    shapes = ellipses.cx_px, ellipses.cy_px, ellipses.a_px, ellipses.b_px, ellipses.theta_rad
    return _lit(shapes, ellipses.bounding_boxes(), sunlit)


@njit()
def _lit(shapes, boxes, sunlit):
    shares = np.zeros(len(boxes))
    for k in range(len(boxes)):
        shares[k] = lit_share(shapes, boxes, k, sunlit)
    return shares


@njit()
def lit_share(shapes, boxes, k, sunlit):
    """Share of the pixels of ellipse k, as `sunlit_fractions`."""
    (cx, cy, a, b, theta), (height, width) = shapes, sunlit.shape
    cos, sin = math.cos(theta[k]), math.sin(theta[k])
    inside = lit = 0
    for row in range(max(floored(boxes[k, 1]), 0), min(-floored(-boxes[k, 3]), height)):
        dy = row + 0.5 - cy[k]
        for column in range(max(floored(boxes[k, 0]), 0), min(-floored(-boxes[k, 2]), width)):
            dx = column + 0.5 - cx[k]
            if ((dx * cos + dy * sin) / a[k]) ** 2 + ((dy * cos - dx * sin) / b[k]) ** 2 <= 1:
                inside += 1
                if sunlit[row, column]:
                    lit += 1
    return lit / inside if inside > 0 else 0.0


def contrasts(centre_px: Array, image_from_rim: Array, grey: np.ndarray, noise: np.ndarray) -> Array:
    """Contrast (N,) of N craters: fitted shading of a bowl lit from one side, over its standard error.

    `centre_px` (N, 2) are the centres of the ellipses. `image_from_rim` (N, 2, 2) maps offsets from the centre in the
    crater's plane, in radii along and across the Sun's direction, to offsets in pixels. `grey` and `noise` (h, w) are
    the mean and standard deviation of each pixel.

    Within REACH radii, grey is fitted by least squares as a plane plus c times the shading of a bowl, -s exp(-(r /
    0.8)^4), with r the distance from the centre and s the offset's component towards the Sun: the wall that faces the
    Sun is bright. The result is c over its standard error, where a pixel's variance is the sum of the variances of
    the noise and of the fit's residuals. The contrast is negative for a bump, about 0 for flat ground, and 0 if too few
    pixels are in the image.
    """
    matrices = np.ascontiguousarray(image_from_rim, np.float64)
    return _shading(centre_px, matrices, np.asarray(grey, np.float64), np.asarray(noise, np.float64))


@njit()
def _shading(centre, matrices, grey, noise):
    result = np.zeros(len(centre))
    scratch = np.empty(N_FITTED), np.empty(N_FITTED), np.empty((N_FITTED, N_FITTED))
    for k in range(len(centre)):
        result[k] = shading(centre, matrices, k, grey, noise, scratch)
    return result


@njit()
def shading(centre, matrices, k, grey, noise, scratch):
    """Contrast of crater k, as `contrasts`; `scratch` has two vectors and a matrix of N_FITTED numbers."""
    height, width = grey.shape
    values, right, normal = scratch
    m00, m01, m10, m11 = matrices[k, 0, 0], matrices[k, 0, 1], matrices[k, 1, 0], matrices[k, 1, 1]
    determinant = m00 * m11 - m01 * m10
    if not math.isfinite(determinant) or determinant == 0:
        return 0.0
    x, y = centre[k, 0], centre[k, 1]
    half_w, half_h = REACH * math.hypot(m00, m01), REACH * math.hypot(m10, m11)
    first, last = max(floored(x - half_w), 0), min(-floored(-(x + half_w)), width)
    for i in range(N_FITTED):
        right[i] = 0.0
        for j in range(N_FITTED):
            normal[i, j] = 0.0
    squares = variance = 0.0
    count = 0
    level = grey[min(max(int(y), 0), height - 1), min(max(int(x), 0), width - 1)]
    for row in range(max(floored(y - half_h), 0), min(-floored(-(y + half_h)), height)):
        dy = row + 0.5 - y
        for column in range(first, last):
            dx = column + 0.5 - x
            s, t = (m11 * dx - m01 * dy) / determinant, (m00 * dy - m10 * dx) / determinant
            square = s * s + t * t
            if square > REACH * REACH:
                continue
            values[0], values[1], values[2] = 1.0, s, t
            values[3] = -s * math.exp(-((square / 0.64) ** 2))
            value = grey[row, column] - level
            for i in range(N_FITTED):
                right[i] += values[i] * value
                for j in range(i + 1):
                    normal[i, j] += values[i] * values[j]
            squares += value * value
            variance += noise[row, column] ** 2
            count += 1
    if count <= N_FITTED:
        return 0.0
    return _last_over_its_error(normal, right, squares, variance / count, count)


@njit()
def _last_over_its_error(normal, right, squares, variance, count):
    """The last fitted value over its standard error, from the Cholesky factors L L^T of `normal`.

    Only the lower triangle of `normal` is read.
    """
    for i in range(N_FITTED):
        for j in range(i + 1):
            rest = normal[i, j]
            for m in range(j):
                rest -= normal[i, m] * normal[j, m]
            if i > j:
                normal[i, j] = rest / normal[j, j]
            elif rest > 1e-9 * normal[i, i]:
                normal[i, i] = math.sqrt(rest)
            else:
                return 0.0
        for m in range(i):
            right[i] -= normal[i, m] * right[m]
        right[i] /= normal[i, i]
        squares -= right[i] ** 2
    # The last unknown is right / d and its variance is 1 / d^2, with d the last diagonal element of L.
    return right[N_FITTED - 1] / math.sqrt(variance + max(squares, 0.0) / (count - N_FITTED))


def smallest_crater(
    crater_id: np.ndarray, circles: Circles, boxes_px: Array, camera: Camera, depth_m: np.ndarray | None
) -> np.ndarray:
    """Id of the smallest crater that each pixel's centre shows (h, w) float32; -1 without a crater.

    A pixel shows a crater if it shows the disc within the rim. `circles` are the rims in O_C, largest first; `boxes_px`
    (N, 4) are the bounding boxes of their images. `camera` has no distortion. `depth_m` (h, w), metres along the
    camera's axis, determines which interiors are hidden; with None, no interior is hidden.
    """
    image = np.full((camera.height_px, camera.width_px), -1, np.float32)
    depth = np.full((1, 1), np.inf) if depth_m is None else depth_m
    _fill(image, crater_id, circles, boxes_px, pinhole_of(camera), depth)
    return image


@njit()
def _fill(image, crater_id, circles, boxes, pinhole, depth):
    (centre, normal, radius), (fx, fy, cx, cy, width, height) = circles, pinhole
    seen = depth.shape == image.shape
    for k in range(len(crater_id)):
        if not np.isfinite(boxes[k]).all():
            continue
        x, y, z = centre[k]
        n_x, n_y, n_z = normal[k]
        distance = n_x * x + n_y * y + n_z * z
        slack = max(SLACK_RADII * radius[k], SLACK_PX * z / fx)
        for row in range(max(int(np.floor(boxes[k, 1])), 0), min(int(np.ceil(boxes[k, 3])), height)):
            ray_y = (row + 0.5 - cy) / fy
            for column in range(max(int(np.floor(boxes[k, 0])), 0), min(int(np.ceil(boxes[k, 2])), width)):
                ray_x = (column + 0.5 - cx) / fx
                towards = n_x * ray_x + n_y * ray_y + n_z
                if towards == 0:
                    continue
                plane = distance / towards
                if plane <= 0 or (seen and depth[row, column] < plane - slack):
                    continue
                square = (plane * ray_x - x) ** 2 + (plane * ray_y - y) ** 2 + (plane - z) ** 2
                if square <= radius[k] ** 2:
                    image[row, column] = crater_id[k]
