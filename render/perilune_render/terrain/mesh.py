"""The height field as vertices and faces, and its export for other tools."""

from pathlib import Path

import numpy as np
import trimesh

from perilune_render.terrain.boulders import rock
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.files import written_aside
from perilune_shared.frames import matrix_from_quaternion


def vertices(scene: Scene) -> np.ndarray:
    """Vertices (n * n, 3) float32 in O_L, metres, row by row."""
    c = scene.grid.coordinates_m.astype(np.float32)
    xyz = np.empty((*scene.height_m.shape, 3), np.float32)
    xyz[..., 0], xyz[..., 1], xyz[..., 2] = c[None, :], c[:, None], scene.height_m
    return xyz.reshape(-1, 3)


def quads(n: int) -> np.ndarray:
    """Faces ((n - 1)^2, 4) int32 of an n x n grid, counter-clockwise from above."""
    corner = np.arange(n * n, dtype=np.int32).reshape(n, n)[:-1, :-1]
    return np.stack([corner, corner + 1, corner + n + 1, corner + n], axis=-1).reshape(-1, 4)


def export_mesh(scene: Scene, path: Path, *, step: int = 1, boulders: bool = True) -> None:
    """Write ground and boulders as GLB, PLY, OBJ or STL, by the path's suffix; every `step`-th vertex of the ground."""
    if path.suffix not in (".glb", ".ply", ".obj", ".stl"):
        raise UserError(path, "format", path.suffix or "none", ".glb, .ply, .obj or .stl")
    n = scene.height_m.shape[0]
    ground = vertices(scene).reshape(n, n, 3)[::step, ::step]
    faces = quads(ground.shape[0])
    parts = [trimesh.Trimesh(ground.reshape(-1, 3), np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]]), process=False)]
    if boulders:
        shapes = {int(i): rock(int(i), scene.seed) for i in np.unique(scene.boulders.shape_id)}
        for k in range(len(scene.boulders)):
            part = shapes[int(scene.boulders.shape_id[k])].copy()
            place = np.eye(4)
            place[:3, :3] = matrix_from_quaternion(scene.boulders.rotation_wxyz[k]) * scene.boulders.diameter_m[k]
            place[:3, 3] = scene.boulders.x_m[k], scene.boulders.y_m[k], scene.boulder_z_m[k]
            parts.append(part.apply_transform(place))
    with written_aside(path) as aside:
        trimesh.util.concatenate(parts).export(aside)
