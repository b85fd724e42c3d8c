"""Errors of depth and normals in EXRs, compared with rays that Embree (by trimesh) casts through the pixels' centres.

Rays, hits (in double precision, from the plane of the hit triangle) and vertex normals are computed without Blender.
Vertices and faces are those given to Blender. Writes runs/bench/truth.json.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig, KindConfig, RenderConfig
from perilune_render.config.terrain import BouldersConfig, TerrainConfig
from perilune_render.flight.view import view_envelope
from perilune_render.imaging.exr import exr_bytes, read_radiance
from perilune_render.imaging.radiance import Radiance
from perilune_render.terrain.boulders import boulder_mesh
from perilune_render.terrain.export import vertices
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene, grow_scene
from perilune_shared.geometry.camera import ROTATION_CAMERA_FROM_BODY, Camera, camera_from_site
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, sun_direction

CAMERA = Camera.from_field_of_view(160, 128, 50.0)
CENTRES = CAMERA.pixel_centres().reshape(-1, 2)
RAYS = CAMERA.rays(CENTRES)
POSES = [(200.0, 0.0, 10.0), (200.0, 45.0, 250.0), (600.0, 20.0, 130.0), (1000.0, 45.0, 20.0), (1500.0, 30.0, 300.0)]
"""Altitude over the ground in metres, tilt from nadir and its azimuth in degrees."""


def pose(scene: Scene, altitude_m: float, tilt_deg: float, azimuth_deg: float) -> tuple[Array, Array]:
    """Position (3,) and rotation_camera_from_site (3, 3) of a camera that looks at ground near the site."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    lean = tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    rotation = ROTATION_CAMERA_FROM_BODY @ matrix_from_rotation_vector(lean)
    x, y, _ = -altitude_m * rotation[2] / abs(rotation[2, 2])
    return np.array([x, y, value_at(scene.height_m, scene.grid, x, y) + altitude_m]), rotation


def vertex_normals(points: Array, quads: np.ndarray) -> Array:
    """Unit normals (V, 3) of vertices: mean of their quads' normals, weighted by the quads' angles at the vertex."""
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
    """First hits of N rays."""

    depth: Array
    """Distance in lengths of the ray's direction, inf for none (N,)."""
    normal: Array
    """Shading normal: interpolated on the ground, the triangle's on boulders (N, 3)."""
    facet: Array
    """Normal of the triangle (N, 3)."""
    rock: np.ndarray
    """Whether the hit is on a boulder (N,)."""


class Caster:
    """Casts rays at a scene's ground and boulders, without Blender."""

    def __init__(self, scene: Scene):
        ground, quads = vertices(scene.grid, scene.height_m).astype(np.float64), scene.grid.quads()
        rocks, rock_faces = boulder_mesh(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)
        self.faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]], rock_faces + len(ground)])
        self.points = np.concatenate([ground, rocks.astype(np.float64)])
        self.normals = vertex_normals(ground, quads)
        self.first_rock = 2 * len(quads)
        self.engine = RayMeshIntersector(trimesh.Trimesh(self.points, self.faces, process=False))

    def cast(self, position: Array, directions: Array) -> Hits:
        """First hits of rays from a position (3,), metres, along directions (N, 3), O_L."""
        face = self.engine.intersects_first(np.broadcast_to(position, directions.shape), directions)
        hit, rock = face >= 0, face >= self.first_rock
        a, b, c = np.moveaxis(self.points[self.faces[face]], 1, 0)
        facet = np.cross(b - a, c - a)
        along = np.sum((a - position) * facet, axis=1) / np.sum(directions * facet, axis=1)
        place = position + directions * along[:, None]
        # Barycentric coordinates, from the areas of the three triangles between hit and corners.
        square = np.sum(facet**2, axis=1)
        shares = [np.sum(np.cross(q - p, place - p) * facet, axis=1) / square for p, q in ((b, c), (c, a), (a, b))]
        corners = np.where((hit & ~rock)[:, None], self.faces[face], 0)
        smooth = sum(share[:, None] * self.normals[corners[:, k]] for k, share in enumerate(shares))
        facet /= np.sqrt(square)[:, None]
        normal = np.where(rock[:, None], facet, smooth / np.linalg.norm(smooth, axis=1, keepdims=True))
        return Hits(np.where(hit, along, np.inf), normal, facet, rock)


@dataclass(frozen=True)
class Frame:
    """One rendered frame and the rays of its pixels."""

    position_m: Array
    """Position of the camera (3,)."""
    rotation: Array
    """rotation_camera_from_site (3, 3)."""
    radiance: Radiance
    """Content of the EXR, (h, w) each."""
    hits: Hits
    """Hits of the rays (h w)."""


def rendered_frames() -> list[Frame]:
    """Render one scene from all poses, write and read the EXRs, cast the rays."""
    kind = KindConfig(n_scenes=1, trajectories_per_scene=1, n_frames=4, split_by="scene")
    terrain = TerrainConfig(spacing_px=1.0, boulders=BouldersConfig(density=10.0))
    config = DatasetConfig(detect=kind, nav=kind, terrain=terrain, render=RenderConfig(samples=2, exr=True))
    scene = grow_scene(config, view_envelope(CAMERA, config.detect.flight), 3)
    caster, found = Caster(scene), []
    # Here, since tests of the other engine import this module where Blender is not installed.
    from perilune_render.engines.blender.renderer import Renderer

    with (
        tempfile.TemporaryDirectory() as folder,
        Renderer(scene, config, CAMERA, sun_direction(60, 30)) as renderer,
    ):
        path = Path(folder) / "frame.exr"
        for seed, place in enumerate(POSES):
            position, rotation = pose(scene, *place)
            radiance = renderer.render(position, rotation, seed)
            path.write_bytes(exr_bytes(radiance, np.zeros_like(radiance.depth_m)))
            found.append(Frame(position, rotation, read_radiance(path), caster.cast(position, RAYS @ rotation)))
    return found


def depth_errors(frame: Frame) -> tuple[Array, np.ndarray]:
    """Relative errors of depth (N,) where EXR and ray both hit, and whether each pixel is on a boulder (N,)."""
    depth, hits = frame.radiance.depth_m.ravel(), frame.hits
    both = np.isfinite(depth) & np.isfinite(hits.depth)
    return np.abs(depth[both] / hits.depth[both] - 1), hits.rock[both]


def normal_errors_deg(frame: Frame) -> tuple[Array, np.ndarray]:
    """Angles between the normals (N,), degrees, for the pixels of `depth_errors`, and whether each is on a boulder."""
    both = np.isfinite(frame.radiance.depth_m.ravel()) & np.isfinite(frame.hits.depth)
    apart = np.linalg.norm(frame.radiance.normal.reshape(-1, 3) - frame.hits.normal, axis=1)[both]
    return np.degrees(2 * np.arcsin(np.minimum(apart / 2, 1))), frame.hits.rock[both]


def projection_errors_px(frame: Frame) -> Array:
    """Projected points minus pixel centres (N, 2), pixels; the points are computed from the depth, in float32."""
    depth = frame.radiance.depth_m.reshape(-1, 1)
    hit = np.isfinite(depth[:, 0])
    place = frame.position_m + (RAYS[hit] * depth[hit]) @ frame.rotation
    return CAMERA.project(camera_from_site(place.astype(np.float32), frame.position_m, frame.rotation)) - CENTRES[hit]


def main() -> None:
    """Run the benchmark."""
    frames = rendered_frames()
    depth = np.concatenate([depth_errors(frame)[0] for frame in frames])
    normal = np.concatenate([normal_errors_deg(frame)[0] for frame in frames])
    figures = {
        "pixels": len(depth),
        "depth_median_relative": float(np.median(depth)),
        "depth_q999_relative": float(np.quantile(depth, 0.999)),
        "depth_share_within_1e-4": float((depth < 1e-4).mean()),
        "normal_median_deg": float(np.median(normal)),
        "normal_q999_deg": float(np.quantile(normal, 0.999)),
        "normal_share_within_0.1_deg": float((normal < 0.1).mean()),
        "projection_worst_px": max(float(np.abs(projection_errors_px(frame)).max()) for frame in frames),
    }
    write_figures(Path("runs/bench/truth.json"), figures)


if __name__ == "__main__":
    main()
