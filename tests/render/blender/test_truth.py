"""Depth and normals of the EXRs against those of rays through the pixels' centres that Embree casts (by trimesh).

Independent of Blender: the rays, their hits (in double precision, from the hit triangle's plane) and the normals of
the vertices. Shared: the vertices and faces that Blender is given.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from tests.helpers.scenes import config_with
from trimesh.ray.ray_pyembree import RayMeshIntersector

from perilune_render.blender.renderer import Renderer
from perilune_render.config import RenderConfig
from perilune_render.config_terrain import BouldersConfig, TerrainConfig
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.exr import read_radiance, write_exr
from perilune_render.terrain.boulders import boulder_mesh
from perilune_render.terrain.export import vertices
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import grow_scene
from perilune_shared.geometry.camera import Camera, camera_from_site
from perilune_shared.geometry.descent import ROTATION_CAMERA_FROM_BODY
from perilune_shared.geometry.frames import matrix_from_rotation_vector, sun_direction

CAMERA = Camera.from_field_of_view(160, 128, 50.0)
CENTRES = CAMERA.pixel_centres().reshape(-1, 2)
RAYS = CAMERA.rays(CENTRES)
POSES = [(200.0, 0.0, 10.0), (200.0, 45.0, 250.0), (600.0, 20.0, 130.0), (1000.0, 45.0, 20.0), (1500.0, 30.0, 300.0)]
"""Altitude over the ground in metres, tilt from nadir and its azimuth in degrees."""
SHARE = 0.999
"""Of the pixels, which must agree: where a triangle is seen edge on, or at its edge, rounding decides what is hit."""


def pose(scene, altitude_m, tilt_deg, azimuth_deg):
    """Position (3,) and rotation_camera_from_site of a camera whose axis meets the ground near the site."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    lean = tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(lean)
    x, y, _ = -altitude_m * rotation[2] / abs(rotation[2, 2])
    return np.array([x, y, value_at(scene.height_m, scene.grid, x, y) + altitude_m]), rotation


def vertex_normals(points, quads):
    """Unit normals (V, 3): of the quads (their vector areas' directions), weighted by their angle at the vertex."""
    corner = points[quads]
    area = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1])
    area /= np.linalg.norm(area, axis=1, keepdims=True)
    normal = np.zeros_like(points)
    for k in range(4):
        to_next, to_last = corner[:, (k + 1) % 4] - corner[:, k], corner[:, k - 1] - corner[:, k]
        lengths = np.linalg.norm(to_next, axis=1) * np.linalg.norm(to_last, axis=1)
        angle = np.arccos(np.clip(np.sum(to_next * to_last, axis=1) / lengths, -1, 1))
        for axis in range(3):
            normal[:, axis] += np.bincount(quads[:, k], angle * area[:, axis], len(points))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@dataclass(frozen=True)
class Hits:
    """What N rays meet."""

    depth: np.ndarray
    """Distance in lengths of the ray's direction, inf for none (N,)."""
    normal: np.ndarray
    """Shading normal: smooth on the ground, the facet's on rocks (N, 3)."""
    facet: np.ndarray
    """Normal of the triangle (N, 3)."""
    rock: np.ndarray
    """Whether it is a rock (N,)."""


class Caster:
    """Rays through a scene's ground and boulders, without Blender."""

    def __init__(self, scene):
        ground, quads = vertices(scene.grid, scene.height_m).astype(np.float64), scene.grid.quads()
        rocks, rock_faces = boulder_mesh(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)
        self.faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]], rock_faces + len(ground)])
        self.points = np.concatenate([ground, rocks.astype(np.float64)])
        self.normals = vertex_normals(ground, quads)
        self.first_rock = 2 * len(quads)
        self.engine = RayMeshIntersector(trimesh.Trimesh(self.points, self.faces, process=False))

    def cast(self, position, directions):
        """What rays from a position (3,) along directions (N, 3) meet first."""
        face = self.engine.intersects_first(np.broadcast_to(position, directions.shape), directions)
        hit, rock = face >= 0, face >= self.first_rock
        a, b, c = np.moveaxis(self.points[self.faces[face]], 1, 0)
        facet = np.cross(b - a, c - a)
        along = np.sum((a - position) * facet, axis=1) / np.sum(directions * facet, axis=1)
        place = position + directions * along[:, None]
        # Barycentric coordinates by the areas of the three triangles that the place makes.
        square = np.sum(facet**2, axis=1)
        shares = [np.sum(np.cross(q - p, place - p) * facet, axis=1) / square for p, q in ((b, c), (c, a), (a, b))]
        corners = np.where((hit & ~rock)[:, None], self.faces[face], 0)
        smooth = sum(share[:, None] * self.normals[corners[:, k]] for k, share in enumerate(shares))
        facet /= np.sqrt(square)[:, None]
        normal = np.where(rock[:, None], facet, smooth / np.linalg.norm(smooth, axis=1, keepdims=True))
        return Hits(np.where(hit, along, np.inf), normal, facet, rock)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Pose by pose: position, rotation, what the EXR says (h, w), what the rays say (h w)."""
    stones = BouldersConfig(density=10.0)
    config = config_with(
        terrain=TerrainConfig(spacing_px=1.0, boulders=stones), render=RenderConfig(samples=2, exr=True)
    )
    scene = grow_scene(config, view_envelope(CAMERA, config.detect.flight), 3)
    caster, path = Caster(scene), tmp_path_factory.mktemp("truth") / "frame.exr"
    found = []
    with Renderer(scene, config, CAMERA, sun_direction(60, 30)) as renderer:
        for seed, place in enumerate(POSES):
            position, rotation = pose(scene, *place)
            radiance = renderer.render(position, rotation, seed)
            write_exr(path, radiance, np.zeros_like(radiance.depth_m))
            found.append((position, rotation, read_radiance(path), caster.cast(position, RAYS @ rotation)))
    return found


def test_the_scene_shows_what_is_to_be_tested(frames):
    assert sum(hits.rock.sum() for *_, hits in frames) > 100
    facets = np.concatenate([hits.facet[np.isfinite(hits.depth)] for *_, hits in frames])
    assert np.quantile(np.degrees(np.arccos(np.abs(facets[:, 2]))), 0.9) > 5
    assert any(np.isinf(hits.depth).any() for *_, hits in frames)


def test_depth_is_that_of_the_ray_through_the_pixels_centre(frames):
    for _, _, radiance, hits in frames:
        depth = radiance.depth_m.ravel()
        assert (np.isfinite(depth) == np.isfinite(hits.depth)).mean() >= SHARE
        both = np.isfinite(depth) & np.isfinite(hits.depth)
        error = np.abs(depth[both] / hits.depth[both] - 1)
        assert (error < 1e-4).mean() >= SHARE and (error[hits.rock[both]] < 1e-4).mean() > 0.98


def test_normals_are_those_of_the_ray_through_the_pixels_centre(frames):
    for _, _, radiance, hits in frames:
        both = np.isfinite(radiance.depth_m.ravel()) & np.isfinite(hits.depth)
        apart = np.linalg.norm(radiance.normal.reshape(-1, 3) - hits.normal, axis=1)[both]
        right = np.degrees(2 * np.arcsin(np.minimum(apart / 2, 1))) < 0.1
        assert right.mean() >= SHARE and right[hits.rock[both]].mean() > 0.98


def test_a_place_found_by_depth_projects_to_its_own_pixel(frames):
    """There and back through O_L, in the float32 of the EXR."""
    for position, rotation, radiance, _ in frames:
        depth = radiance.depth_m.reshape(-1, 1)
        hit = np.isfinite(depth[:, 0])
        place = position + (RAYS[hit] * depth[hit]) @ rotation
        back = CAMERA.project(camera_from_site(place.astype(np.float32), position, rotation))
        assert np.abs(back - CENTRES[hit]).max() < 0.01


def test_blenders_rays_go_through_the_pixels_centres(frames):
    """A ray beside the centre meets each facet at another depth: how far beside explains what difference there is?

    The plane with normal n through a point at depth Z on the ray r(u, v) gives dZ/du = -Z (n . dr/du) / (n . r).
    """
    for _, rotation, radiance, hits in frames:
        depth = radiance.depth_m.ravel()
        both = np.isclose(depth, hits.depth, rtol=1e-4, atol=0) & np.isfinite(depth)
        slope = -hits.depth[both, None] * (hits.facet[both] @ rotation[:2].T) / CAMERA.fx_px
        slope /= np.sum(hits.facet[both] * (RAYS[both] @ rotation), axis=1)[:, None]
        difference = depth[both] - hits.depth[both]
        least_px = np.abs(difference) / np.linalg.norm(slope, axis=1)
        assert (least_px < 0.01).mean() >= SHARE
        of_the_frame_px = np.linalg.lstsq(slope, difference, rcond=None)[0]
        assert np.abs(of_the_frame_px).max() < 0.001
