"""Crater labels of a frame: ellipses, how much of each rim is seen, how much of each crater is lit."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from perilune_render.exr import Radiance
from perilune_render.terrain.scene import Scene
from perilune_shared.camera import Camera, camera_from_site
from perilune_shared.ellipse import Ellipses, project_circles, rim_points
from perilune_shared.frames import Array

_N_RIM = 48


@dataclass(frozen=True, slots=True)
class Labels:
    """N labelled craters of one frame."""

    crater_id: np.ndarray
    """Place in the scene's craters (N,)."""
    ellipses: Ellipses
    """Images of the rims."""
    visible_fraction: Array
    """Share of the rim inside the image and not hidden (N,)."""
    sunlit_fraction: Array
    """Share of the crater's seen pixels that the Sun reaches; 0 where none is seen (N,)."""

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
        )


@dataclass(frozen=True, slots=True)
class RimCircles:
    """The rim circles of N craters of a scene, O_L."""

    crater_id: np.ndarray
    """Unique in the scene (N,)."""
    centre_m: Array
    """(N, 3)."""
    normal: Array
    """Unit normals (N, 3)."""
    radius_m: Array
    """(N,)."""

    @classmethod
    def of_scene(cls, scene: Scene) -> "RimCircles":
        """All craters of a scene that was grown."""
        centres = np.stack([scene.craters.x_m, scene.craters.y_m, scene.rims.z_m], axis=1)
        return cls(np.arange(len(scene.craters)), centres, scene.rims.normal, scene.craters.diameter_m / 2)

    @classmethod
    def from_table(cls, rows: pd.DataFrame) -> "RimCircles":
        """Rows of the manifest's table `craters`, of one scene."""
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
    min_radius_px: float,
    max_radius_px: float,
) -> Labels:
    """Labels by the paper's rule: centre in the frame, radius within bounds; visibility from the rendered depth.

    `radiance` is in the pixels of `camera` (`perilune_render.resample.seen_by`).
    """
    in_camera = camera_from_site(circles.centre_m, position_m, rotation_camera_from_site)
    rough = camera.fx_px * circles.radius_m / np.maximum(in_camera[:, 2], 1e-9)
    candidate = np.flatnonzero(camera.inside(camera.project(in_camera)) & (rough > 0.5 * min_radius_px))
    ellipses = project_circles(
        camera,
        in_camera[candidate],
        circles.normal[candidate] @ rotation_camera_from_site.T,
        circles.radius_m[candidate],
    )
    radius = ellipses.radius_px()
    kept = (radius >= min_radius_px) & (radius <= max_radius_px)
    rows = candidate[kept]
    ellipses = Ellipses(
        ellipses.cx_px[kept],
        ellipses.cy_px[kept],
        ellipses.a_px[kept],
        ellipses.b_px[kept],
        ellipses.theta_rad[kept],
    )
    visible = _visible_fraction(circles, camera, position_m, rotation_camera_from_site, radiance.depth_m, rows)
    return Labels(circles.crater_id[rows], ellipses, visible, _sunlit_fraction(ellipses, radiance.sunlit))


def _visible_fraction(
    circles: RimCircles, camera: Camera, position_m: Array, rotation: Array, depth_m: np.ndarray, rows: np.ndarray
) -> Array:
    """Compare the rim's depth with the rendered depth.

    The label circle is a plane through a rough rim, so a rim point may lie under the ground by some of the crater's own
    height: it counts as hidden only where the ground in front is nearer by more than a tenth of the radius and
    two pixels' width.
    """
    if not len(rows):
        return np.empty(0)
    radii = circles.radius_m[rows]
    rims = rim_points(circles.centre_m[rows], circles.normal[rows], radii, _N_RIM)
    points = camera_from_site(rims, position_m, rotation)
    pixels = camera.project(points)
    inside = camera.inside(pixels)
    column = np.where(inside, pixels[..., 0], 0).astype(int)
    row = np.where(inside, pixels[..., 1], 0).astype(int)
    slack = np.maximum(0.1 * radii, 2 * points[:, 0, 2] / camera.fx_px)
    return (inside & (points[..., 2] <= depth_m[row, column] + slack[:, None])).mean(axis=1)


def _sunlit_fraction(ellipses: Ellipses, sunlit: np.ndarray) -> Array:
    """Share of lit pixels among those whose centre lies in each ellipse and in the image."""
    height, width = sunlit.shape
    boxes = ellipses.bounding_boxes()
    lit = np.zeros(len(boxes))
    x0, y0 = (
        np.clip(np.floor(boxes[:, 0]), 0, width).astype(int),
        np.clip(np.floor(boxes[:, 1]), 0, height).astype(int),
    )
    x1, y1 = (
        np.clip(np.ceil(boxes[:, 2]), 0, width).astype(int),
        np.clip(np.ceil(boxes[:, 3]), 0, height).astype(int),
    )
    for k in range(len(boxes)):
        inside = _inside_ellipse(ellipses, k, x0[k], y0[k], x1[k], y1[k])
        if inside.any():
            lit[k] = float(sunlit[y0[k] : y1[k], x0[k] : x1[k]][inside].mean())
    return lit


def _inside_ellipse(ellipses: Ellipses, k: int, x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    dx = np.arange(x0, x1)[None, :] + 0.5 - ellipses.cx_px[k]
    dy = np.arange(y0, y1)[:, None] + 0.5 - ellipses.cy_px[k]
    cos, sin = np.cos(ellipses.theta_rad[k]), np.sin(ellipses.theta_rad[k])
    return ((dx * cos + dy * sin) / ellipses.a_px[k]) ** 2 + ((dy * cos - dx * sin) / ellipses.b_px[k]) ** 2 <= 1


def crater_index(
    circles: RimCircles, camera: Camera, position_m: Array, rotation_camera_from_site: Array
) -> np.ndarray:
    """Index image (h, w) float32 of the smallest crater whose rim each pixel's centre lies in; -1 none.

    Every crater of at least a pixel across counts, also those that become no labels.
    """
    in_camera = camera_from_site(circles.centre_m, position_m, rotation_camera_from_site)
    rough = camera.fx_px * circles.radius_m / np.maximum(in_camera[:, 2], 1e-9)
    candidate = np.flatnonzero((rough > 0.5) & (in_camera[:, 2] > 0))
    candidate = candidate[np.argsort(-circles.radius_m[candidate], kind="stable")]
    ellipses = project_circles(
        camera,
        in_camera[candidate],
        circles.normal[candidate] @ rotation_camera_from_site.T,
        circles.radius_m[candidate],
    )
    image = np.full((camera.height_px, camera.width_px), -1, np.float32)
    boxes = ellipses.bounding_boxes()
    size = (camera.width_px, camera.height_px)
    in_view = (boxes[:, 0] < size[0]) & (boxes[:, 1] < size[1]) & (boxes[:, 2] > 0) & (boxes[:, 3] > 0)
    for k in np.flatnonzero(in_view):
        x0, y0 = (int(np.clip(np.floor(boxes[k, i]), 0, size[i])) for i in (0, 1))
        x1, y1 = (int(np.clip(np.ceil(boxes[k, 2 + i]), 0, size[i])) for i in (0, 1))
        if x1 > x0 and y1 > y0:
            image[y0:y1, x0:x1][_inside_ellipse(ellipses, k, x0, y0, x1, y1)] = circles.crater_id[candidate[k]]
    return image
