"""Thin glowing rings on rim circles: rendered by Blender, then located in the picture with subpixel accuracy.

A ring is a tube around the circle. In the picture its middle line is the image of the circle: the outlines of a thin
tube are symmetric about it, except for terms of the tube's width squared over distance and radius. Along a normal of a
label's ellipse the ring's brightness has one maximum; its centroid is the position of the middle line.
"""

from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from perilune_render.config.dataset import LightConfig, RenderConfig
from perilune_render.engines.blender import bpy
from perilune_render.engines.blender.renderer import configure, render_through
from perilune_render.engines.blender.stage import aim, mesh_from_arrays, sunlit_stage
from perilune_render.imaging.radiance import Radiance
from perilune_render.labels.frame_labels import Labels, RimCircles, label_frame
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.ellipse import Ellipses, rim_points
from perilune_shared.geometry.frames import Array

TUBE_PX = 1.5
"""Half the width of a ring, pixels of the picture."""
REACH_PX = 6.0
"""Search distance from the ellipse, pixels of the picture."""
LEAST_AXIS_PX = REACH_PX + TUBE_PX + 1
"""Smallest semi-minor axis, pixels of the picture: the far side of a narrower ring would be within REACH_PX."""
LEAST_BEND_PX = 2 * TUBE_PX
"""Smallest radius of curvature, pixels of the picture: at sharper ends both sides would be within REACH_PX."""
APART_PX = REACH_PX + TUBE_PX + 4
"""Smallest distance between rings, pixels of the picture."""
N_DIRECTIONS = 64
_N_AROUND, _N_TUBE = 512, 8
"""Number of vertices around the circle, and around the tube."""
_STEP_PX = 0.125
"""Distance between brightness samples along a normal, pixels of the picture."""


def labels_of(circles: RimCircles, camera: Camera, position_m: Array, rotation_camera_from_site: Array) -> Labels:
    """Labels of 2 to 50 px by the project's rule, without occlusion."""
    shape = (camera.height_px, camera.width_px)
    nothing = Radiance(np.zeros(shape), np.full(shape, np.inf), np.zeros((*shape, 3)), np.zeros(shape, bool))
    return label_frame(circles, camera, position_m, rotation_camera_from_site, nothing, (2.0, 50.0))


def rows_of(ellipses: Ellipses, rows: np.ndarray) -> Ellipses:
    """The given rows of the ellipses."""
    e = ellipses
    return Ellipses(e.cx_px[rows], e.cy_px[rows], e.a_px[rows], e.b_px[rows], e.theta_rad[rows])


def outline(ellipses: Ellipses, n: int) -> tuple[Array, Array]:
    """Points (N, n, 2) on the ellipses and the outward unit normals (N, n, 2) at these points."""
    e, angle = ellipses, 2 * np.pi * np.arange(n) / n
    x, y = e.a_px[:, None] * np.cos(angle), e.b_px[:, None] * np.sin(angle)
    along, across = np.cos(angle) / e.a_px[:, None], np.sin(angle) / e.b_px[:, None]
    cos, sin = np.cos(e.theta_rad)[:, None], np.sin(e.theta_rad)[:, None]
    points = np.stack([e.cx_px[:, None] + x * cos - y * sin, e.cy_px[:, None] + x * sin + y * cos], axis=-1)
    normals = np.stack([along * cos - across * sin, along * sin + across * cos], axis=-1)
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def wide_enough(ellipses: Ellipses, scale: int) -> np.ndarray:
    """Whether rings on the ellipses (N,) can be measured in the picture.

    The picture has `scale` x `scale` pixels for each label pixel.
    """
    bend_px = ellipses.b_px**2 / ellipses.a_px
    return (ellipses.b_px * scale >= LEAST_AXIS_PX) & (bend_px * scale >= LEAST_BEND_PX)


def apart(ellipses: Ellipses, camera: Camera, scale: int) -> np.ndarray:
    """Rows of ellipses, largest first, that lie entirely in the frame and whose rings do not touch in the picture.

    The picture has `scale` x `scale` pixels for each of the camera's pixels.
    """
    boxes, edge = ellipses.bounding_boxes(), APART_PX / scale
    whole = (boxes[:, :2] > edge).all(axis=1)
    whole &= (boxes[:, 2] < camera.width_px - edge) & (boxes[:, 3] < camera.height_px - edge)
    rows = np.flatnonzero(whole & wide_enough(ellipses, scale))
    points = outline(ellipses, 128)[0]
    fine = max(4, scale // 2)
    taken = np.zeros((fine * camera.height_px, fine * camera.width_px), np.uint8)
    kept = []
    for row in rows[np.argsort(-ellipses.a_px[rows], kind="stable")]:
        line = [np.rint(points[row] * fine).astype(np.int32)]
        if cv2.polylines(np.zeros_like(taken), line, True, 1)[taken > 0].any():
            continue
        cv2.polylines(taken, line, True, 1, thickness=int(np.ceil(2 * APART_PX / scale * fine)) + 1)
        kept.append(row)
    return np.array(kept, int)


def render_rings(
    folder: Path,
    circles: RimCircles,
    rows: np.ndarray,
    camera: Camera,
    position_m: Array,
    rotation: Array,
    samples: int,
) -> np.ndarray:
    """Render a picture (h, w) of rings, 2 TUBE_PX pixels wide, on some of the circles: 1 on rings, 0 elsewhere."""
    centres, radii = circles.centre_m[rows], circles.radius_m[rows]
    tubes_m = TUBE_PX / camera.fx_px * camera_from_site(centres, position_m, rotation)[:, 2]
    light, up = LightConfig(), np.array([0.0, 0.0, 1.0])
    stage = sunlit_stage(light, camera, up)
    mesh = mesh_from_arrays("rings", *tubes(centres, circles.normal[rows], radii, tubes_m))
    mesh.materials.append(_glow())
    stage.collection.objects.link(bpy.data.objects.new("rings", mesh))
    configure(stage, camera, RenderConfig(samples=samples), light)
    aim(stage, position_m, rotation)
    return render_through(folder / "rings.exr", stage, 0).radiance_factor


def tubes(centres_m: Array, normals: Array, radii_m: Array, tubes_m: Array) -> tuple[Array, np.ndarray]:
    """Tubes of radii tubes_m (N,) about N circles: vertices (V, 3) and quads (F, 4)."""
    turn = 2 * np.pi * np.arange(_N_TUBE) / _N_TUBE
    lines = [
        rim_points(
            centres_m + tubes_m[:, None] * np.sin(phi) * normals, normals, radii_m + tubes_m * np.cos(phi), _N_AROUND
        )
        for phi in turn
    ]
    points = np.stack(lines, axis=2)
    n, around, tube = np.ogrid[: len(radii_m), :_N_AROUND, :_N_TUBE]
    next_around, next_tube = (around + 1) % _N_AROUND, (tube + 1) % _N_TUBE
    corners = [(around, tube), (next_around, tube), (next_around, next_tube), (around, next_tube)]
    quads = np.stack([(n * _N_AROUND + i) * _N_TUBE + j for i, j in corners], axis=-1)
    return points.reshape(-1, 3), quads.reshape(-1, 4)


def ring_offsets(picture: np.ndarray, scale: int, ellipses: Ellipses) -> Array:
    """Distances (N, N_DIRECTIONS) of the rings from the ellipses along the ellipses' outward normals, label pixels.

    `picture` has `scale` x `scale` pixels for each label pixel. NaN where no complete ring lies within REACH_PX.
    """
    points, normals = outline(ellipses, N_DIRECTIONS)
    steps = np.arange(-REACH_PX, REACH_PX + 0.5 * _STEP_PX, _STEP_PX)
    places = scale * points[..., None, :] + steps[:, None] * normals[..., None, :] - 0.5
    brightness = map_coordinates(picture, np.moveaxis(places[..., ::-1], -1, 0), order=1)
    total = brightness.sum(axis=-1) * _STEP_PX
    whole = (total > TUBE_PX) & (brightness[..., 0] < 0.01) & (brightness[..., -1] < 0.01)
    return np.where(whole, (brightness @ steps) * _STEP_PX / np.where(whole, total, 1.0), np.nan) / scale


def errors_px(offsets: Array, scale: int) -> Array:
    """Error (N,) of each label: the r.m.s. distance of ring and ellipse over all directions, label pixels.

    A direction without a ring counts as the largest measurable distance.
    """
    return np.sqrt(np.mean(np.square(np.where(np.isnan(offsets), REACH_PX / scale, offsets)), axis=1))


def _glow() -> bpy.types.Material:
    """A surface of radiance 1 that does not illuminate others."""
    material = bpy.data.materials.new("glow")
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"
    tree = material.node_tree
    tree.nodes.clear()
    emission, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    return material
