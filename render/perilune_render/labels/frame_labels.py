"""Crater labels of a frame: ellipse, visible share of the rim, sunlit share and contrast."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from perilune_render.imaging.radiance import Radiance
from perilune_render.labels.pixels import (
    Circles,
    Rims,
    centred_in,
    contrasts,
    rim_shares,
    smallest_crater,
    sunlit_fractions,
)
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import Ellipses, plane_basis, project_circles, rim_points
from perilune_shared.geometry.frames import Array
from perilune_shared.labels.masks import SLACK_PX, SLACK_RADII, crater_masks

_N_RIM = 48
_ANGLES = 2 * np.pi * np.arange(_N_RIM) / _N_RIM
_RIM = np.cos(_ANGLES), np.sin(_ANGLES)


@dataclass(frozen=True, slots=True)
class Labels:
    """N labelled craters of one frame."""

    crater_id: np.ndarray
    """Id in the table `craters` of the scene (N,)."""
    ellipses: Ellipses
    """Ellipses of the rims in the image."""
    visible_fraction: Array
    """Share of the rim that is inside the image and not hidden (N,)."""
    sunlit_fraction: Array
    """Sunlit share of the pixels that the ellipse covers in the image; 0 if it covers none (N,)."""
    contrast: Array
    """Amplitude of the crater's shading, divided by its standard error (`perilune_render.labels.pixels.contrasts`); NaN
    if not measured (N,)."""
    n_above: int | None = None
    """Number of craters that have their centre in the image but are too large for a label; None if not counted."""

    @classmethod
    def from_table(cls, rows: pd.DataFrame) -> "Labels":
        """Labels of one frame from rows of the manifest's table `labels`."""
        ellipses = Ellipses(
            *(rows[f"ellipse_{name}"].to_numpy() for name in ("cx_px", "cy_px", "a_px", "b_px", "theta_rad"))
        )
        return cls(
            rows["crater_id"].to_numpy(),
            ellipses,
            rows["visible_fraction"].to_numpy(),
            rows["sunlit_fraction"].to_numpy(),
            rows["contrast"].to_numpy(),
        )


@dataclass(frozen=True, slots=True)
class GreyAndSun:
    """Mean and noise of a frame's grey values (`perilune_render.imaging.sensor.expected`), and the Sun."""

    grey: np.ndarray
    """Mean of each grey value, DN (h, w)."""
    noise: np.ndarray
    """Standard deviation of each grey value, DN (h, w)."""
    sun: Array
    """Unit vector (3,) towards the Sun, O_L."""


@dataclass(frozen=True, slots=True)
class RimCircles:
    """The rim circles of N craters of a scene, O_L."""

    crater_id: np.ndarray
    """Crater ids, unique in the scene, ascending (N,)."""
    centre_m: Array
    """Centres, metres (N, 3)."""
    normal: Array
    """Unit normals of the rim planes (N, 3)."""
    radius_m: Array
    """Radii, metres (N,)."""

    @classmethod
    def of_scene(cls, scene: Scene) -> "RimCircles":
        """All craters of a generated scene."""
        centres = np.stack([scene.craters.x_m, scene.craters.y_m, scene.rims.z_m], axis=1)
        return cls(scene.crater_id, centres, scene.rims.normal, scene.craters.diameter_m / 2)

    @classmethod
    def from_table(cls, rows: pd.DataFrame) -> "RimCircles":
        """Craters of one scene from rows of the manifest's table `craters`."""
        rows = rows.sort_values("crater_id")
        return cls(
            rows["crater_id"].to_numpy(),
            rows[["x_m", "y_m", "z_m"]].to_numpy(),
            rows[["normal_x", "normal_y", "normal_z"]].to_numpy(),
            rows["diameter_m"].to_numpy() / 2,
        )


def label_frame(
    circles: RimCircles,
    camera: Camera,
    position_m: Array,
    rotation_camera_from_site: Array,
    radiance: Radiance,
    radii_px: tuple[float, float],
) -> Labels:
    """Labels of a frame: craters with their centre in the image and a radius sqrt(a b) within `radii_px`.

    `radii_px` are the smallest and the largest radius, pixels. `position_m` (3,) is in O_L. Visibility is computed from
    the depth in `radiance`, which has the pixels of `camera` (`perilune_render.imaging.resampling.seen_by`). The
    contrast also depends on the sensor, so it is NaN until `with_contrast` adds it.
    """
    pose = position_m, rotation_camera_from_site
    labels = centred_labels(circles, camera, *pose, radii_px)
    rows = np.searchsorted(circles.crater_id, labels.crater_id)
    visible = _visible_fraction(circles, camera, *pose, radiance.depth_m, rows)
    return replace(labels, visible_fraction=visible, sunlit_fraction=sunlit_fractions(labels.ellipses, radiance.sunlit))


def centred_labels(
    circles: RimCircles,
    camera: Camera,
    position_m: Array,
    rotation_camera_from_site: Array,
    radii_px: tuple[float, float],
) -> Labels:
    """The labels of `label_frame`, with NaN for everything that is read from the pixels of a rendering."""
    pose, (min_radius_px, max_radius_px) = (position_m, rotation_camera_from_site), radii_px
    if camera.distorts:
        in_camera = _in_camera(circles.centre_m, *pose)
        rough = camera.scale_px * circles.radius_m / np.maximum(camera.depth_m(in_camera), 1e-9)
        candidate = np.flatnonzero(camera.inside(camera.project(in_camera)) & (rough > 0.5 * min_radius_px))
        in_camera = in_camera[candidate]
    else:
        in_site = Circles(circles.centre_m, circles.normal, circles.radius_m)
        candidate, in_camera = centred_in(camera, *pose, in_site, min_radius_px)
    ellipses = project_circles(
        camera,
        in_camera,
        circles.normal[candidate] @ rotation_camera_from_site.T,
        circles.radius_m[candidate],
    )
    radius = ellipses.radius_px()
    in_range = (radius >= min_radius_px) & (radius <= max_radius_px)
    rows = candidate[in_range]
    ellipses = Ellipses(
        ellipses.cx_px[in_range],
        ellipses.cy_px[in_range],
        ellipses.a_px[in_range],
        ellipses.b_px[in_range],
        ellipses.theta_rad[in_range],
    )
    unknown = np.full(len(rows), np.nan)
    n_above = int((radius > max_radius_px).sum())
    return Labels(circles.crater_id[rows], ellipses, unknown, unknown, unknown, n_above)


def _in_camera(points_m: Array, position_m: Array, rotation_camera_from_site: Array) -> Array:
    """`camera_from_site` for many points (N, 3), faster.

    NumPy subtracts long columns ten times as fast as rows of three numbers.
    """
    offset = np.empty_like(points_m)
    for k in range(3):
        np.subtract(points_m[:, k], position_m[k], out=offset[:, k])
    return offset @ rotation_camera_from_site.T


def with_contrast(
    labels: Labels,
    circles: RimCircles,
    camera: Camera,
    position_m: Array,
    rotation_camera_from_site: Array,
    image: GreyAndSun,
) -> Labels:
    """The labels with their contrast in the image of `camera` (`labels.pixels.contrasts`)."""
    rows = np.searchsorted(circles.crater_id, labels.crater_id)
    centre = np.stack([labels.ellipses.cx_px, labels.ellipses.cy_px], axis=-1)
    matrices = image_from_rim(circles, camera, position_m, rotation_camera_from_site, image.sun, rows)
    return replace(labels, contrast=contrasts(centre, matrices, image.grey, image.noise))


def shading_axes(
    crater_id: np.ndarray, circles: RimCircles, camera: Camera, position_m: Array, rotation: Array, sun: Array
) -> Array:
    """Matrices (N, 2, 2) that map offsets in the rim planes of craters to pixels, as `with_contrast` uses them.

    The offsets are in radii, along and across the direction of the Sun.
    """
    rows = np.searchsorted(circles.crater_id, crater_id)
    return image_from_rim(circles, camera, position_m, rotation, sun, rows)


def image_from_rim(
    circles: RimCircles, camera: Camera, position_m: Array, rotation: Array, sun: Array, rows: np.ndarray
) -> Array:
    """Matrices (N, 2, 2) that map offsets in each rim's plane to pixels.

    The offsets are in radii, along and across the direction of the Sun.
    """
    centre, normal = circles.centre_m[rows], circles.normal[rows]
    along = sun - (normal @ sun)[:, None] * normal
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # With the Sun along the rim's normal, no direction in the plane points towards the Sun: use any direction.
    along = np.where(length > 1e-9, along / np.maximum(length, 1e-9), plane_basis(normal)[0])
    axes = circles.radius_m[rows, None, None] * np.stack([along, np.cross(normal, along)], axis=1)
    ends = [camera.project(camera_from_site(centre[:, None] + side * axes, position_m, rotation)) for side in (1, -1)]
    return np.swapaxes(ends[0] - ends[1], 1, 2) / 2


def rims_of(circles: RimCircles, rows: np.ndarray) -> Rims:
    """The points of these rims at which visibility is tested."""
    return Rims(circles.centre_m[rows], *plane_basis(circles.normal[rows]), circles.radius_m[rows], *_RIM)


def _visible_fraction(
    circles: RimCircles, camera: Camera, position_m: Array, rotation: Array, depth_m: np.ndarray, rows: np.ndarray
) -> Array:
    """Visible share (N,) of each rim, by comparing the rim's depth with the rendered depth.

    The label circle is flat and the real rim is rough, so a point of the circle may be below the ground. The point
    counts as hidden only if the ground in front of it is nearer by more than SLACK_RADII radii and by more than
    SLACK_PX pixel widths. A point on a pixel of the sky is beyond the horizon and also counts as hidden.
    """
    if not len(rows):
        return np.empty(0)
    radii = circles.radius_m[rows]
    if not camera.distorts:
        return rim_shares(rims_of(circles, rows), camera, position_m, rotation, depth_m)
    points_m = rim_points(circles.centre_m[rows], circles.normal[rows], radii, _N_RIM)
    points = camera_from_site(points_m, position_m, rotation)
    pixels = camera.project(points)
    inside = camera.inside(pixels)
    column = np.where(inside, pixels[..., 0], 0).astype(int)
    row = np.where(inside, pixels[..., 1], 0).astype(int)
    point_m = camera.depth_m(points)
    slack = np.maximum(SLACK_RADII * radii, SLACK_PX * point_m[:, 0] / camera.scale_px)
    depth = depth_m[row, column]
    return (inside & np.isfinite(depth) & (point_m <= depth + slack[:, None])).mean(axis=1)


def crater_index(
    circles: RimCircles,
    camera: Camera,
    position_m: Array,
    rotation_camera_from_site: Array,
    depth_m: np.ndarray | None = None,
) -> np.ndarray:
    """Id of the smallest crater that each pixel's centre shows (h, w) float32; -1 without a crater.

    A pixel shows a crater if it shows the interior, the disc within the rim. The interior is hidden where the ground is
    nearer than the disc by more than SLACK_RADII radii and by more than SLACK_PX pixel widths. `depth_m` (h, w) is the
    depth of the ground, metres; without it, no interior is hidden. Pixels of the sky (infinite depth) are -1. All
    craters at least a pixel wide are included, even if they have no label. `camera` has no distortion, but may have a
    lens model.
    """
    in_camera = camera_from_site(circles.centre_m, position_m, rotation_camera_from_site)
    candidate = _reaching_in(camera, in_camera, circles.radius_m)
    candidate = candidate[np.argsort(-circles.radius_m[candidate], kind="stable")]
    centres, radii = in_camera[candidate], circles.radius_m[candidate]
    normals = circles.normal[candidate] @ rotation_camera_from_site.T
    if camera.distorts:
        image = np.full((camera.height_px, camera.width_px), -1, np.float32)
        for mask in crater_masks(camera, circles.crater_id[candidate].tolist(), centres, normals, radii, depth_m):
            image[mask.window][mask.amodal if mask.visible is None else mask.visible] = mask.crater_id
        return image
    boxes = project_circles(camera, centres, normals, radii).bounding_boxes()
    image = smallest_crater(circles.crater_id[candidate], Circles(centres, normals, radii), boxes, camera, depth_m)
    if depth_m is not None:
        image[~np.isfinite(depth_m)] = -1
    return image


def _reaching_in(camera: Camera, centre_m: Array, radius_m: Array) -> np.ndarray:
    """Indices of the circles in O_C that may extend into the image and are at least a pixel wide.

    `centre_m` is (N, 3), `radius_m` is (N,).
    """
    x, y, z = centre_m.T
    if camera.distorts:
        return np.flatnonzero((z > 0) & (2 * camera.scale_px * radius_m > camera.depth_m(centre_m)))
    rows = np.flatnonzero((z > 0) & (2 * camera.fx_px * radius_m > z))
    x, y, z, radius = x[rows], y[rows], z[rows], radius_m[rows]
    with np.errstate(divide="ignore"):
        # Upper bound on how far a sphere of this radius extends from its centre in the image.
        wide = np.where(z > radius, radius / np.abs(z - radius), np.inf)
    size = np.array([camera.width_px, camera.height_px])
    middle = np.stack([camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px], axis=-1)
    reach = np.stack([camera.fx_px * np.hypot(1, x / z), camera.fy_px * np.hypot(1, y / z)], axis=-1) * wide[:, None]
    return rows[((middle > -reach) & (middle < size + reach)).all(axis=1)]
