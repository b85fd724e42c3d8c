import numpy as np
import pytest
import rasterio
import trimesh

from perilune_render.terrain.elevation.model import base_heights, read_elevation
from perilune_render.terrain.export import export_mesh, export_raster
from perilune_render.terrain.interpolation import value_at
from perilune_shared.errors import UserError


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb", ".obj"])
def test_a_mesh_is_the_ground_in_metres(scene, tmp_path, suffix):
    path = tmp_path / f"scene{suffix}"
    export_mesh(scene, path, step=4)
    mesh = trimesh.load(path, force="mesh")
    if suffix in (".glb", ".obj"):
        # Y is up: Blender and three.js turn such files by this much.
        x, y, z = mesh.vertices.T
        mesh.vertices = np.stack([x, -z, y], axis=-1)
    assert mesh.extents[0] == pytest.approx(scene.grid.extent_m, rel=1e-5)
    inner = mesh.vertices[np.abs(mesh.vertices[:, :2]).max(axis=1) < 200]
    assert len(inner) > 1000
    assert np.allclose(inner[:, 2], value_at(scene.height_m, scene.grid, inner[:, 0], inner[:, 1]), atol=2e-3)
    assert (mesh.face_normals[:, 2] > 0).all()


def test_every_vertex_is_there_without_a_step(scene, tmp_path):
    export_mesh(scene, tmp_path / "scene.ply")
    assert len(trimesh.load(tmp_path / "scene.ply", process=False).vertices) == scene.grid.n_vertices


def test_a_raster_comes_back_as_the_same_ground(scene, tmp_path):
    path = tmp_path / "scene.tif"
    export_raster(scene, path, 4.0)
    with rasterio.open(path) as raster:
        assert raster.dtypes == ("float32",) and raster.res == (4.0, 4.0)
    model = read_elevation(path)
    assert model.latitude_deg == pytest.approx(scene.latitude_deg) and model.pixel_m == pytest.approx(4, rel=1e-3)
    x, y = np.random.default_rng(1).uniform(-300, 300, (2, 500))
    again = value_at(base_heights(model, scene.grid)[0], scene.grid, x, y)
    error = again - value_at(scene.height_m, scene.grid, x, y)
    assert np.std(error) < 0.15 and np.abs(error).max() < 1.5


def test_a_raster_too_large_is_refused(scene, tmp_path):
    with pytest.raises(UserError, match="pixels per side"):
        export_raster(scene, tmp_path / "scene.tif", 0.01)
    assert not list(tmp_path.iterdir())
