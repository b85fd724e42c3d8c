"""Export a scene for other tools: meshes (GLB, PLY, OBJ, STL) and a height raster (GeoTIFF)."""

from pathlib import Path
from typing import Any

import numpy as np

from perilune_render.terrain.boulders import boulder_mesh
from perilune_render.terrain.grid import Grid
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M
from perilune_shared.storage.files import written_aside

MESH_SUFFIXES = (".glb", ".ply", ".obj", ".stl")
RASTER_SUFFIXES = (".tif", ".tiff")
_LARGEST_SIDE = 20_000
_Y_UP = (".glb", ".obj")
"""Formats whose readers take Y as up: glTF by specification, OBJ by convention. PLY and STL keep the axes of O_L."""
_ROWS_AT_ONCE = 256


def vertices(grid: Grid, height_m: np.ndarray) -> np.ndarray:
    """Vertices (n_vertices, 3) float32 in O_L, metres."""
    xyz = np.empty((grid.n_vertices, 3), np.float32)
    xyz[:, 0], xyz[:, 1] = grid.vertices_xy()
    xyz[:, 2] = height_m
    return xyz


def coarser(grid: Grid, step: int) -> Grid:
    """A grid of the same ground, with every `step`-th ring and about 1 / step of each ring's vertices."""
    n_half = max(grid.n_half // step, 1)
    rings = grid.half_widths_m[::-step][::-1] if len(grid.half_widths_m) > 1 else grid.half_widths_m
    return Grid(n_half, np.unique(np.concatenate([grid.half_widths_m[:1], rings])))


def export_mesh(scene: Scene, path: Path, *, step: int = 1, boulders: bool = True) -> None:
    """Write a mesh of ground and boulders, metres; `step` multiplies the ground's vertex spacing.

    The axes are the axes of O_L (x west, y south, z up); in GLB and OBJ they are x west, y up, z north.
    """
    import trimesh

    grid = scene.grid if step == 1 else coarser(scene.grid, step)
    height = scene.height_m if step == 1 else value_at(scene.height_m, scene.grid, *grid.vertices_xy())
    faces = grid.quads()
    triangles = np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]])
    parts = [trimesh.Trimesh(vertices(grid, height), triangles, process=False)]
    if boulders and len(scene.boulders):
        solid = boulder_mesh(scene.boulders, scene.boulder_z_m, scene.grid, scene.seed)
        parts.append(trimesh.Trimesh(*solid, process=False))
    if path.suffix.lower() in _Y_UP:
        for part in parts:
            x, y, z = part.vertices.T
            part.vertices = np.stack([x, z, -y], axis=-1)
    with written_aside(path) as aside:
        trimesh.util.concatenate(parts).export(aside)


def site_profile(latitude_deg: float, longitude_deg: float, n: int, pixel_m: float, n_bands: int) -> dict[str, Any]:
    """Options of rasterio for a float32 GeoTIFF of n x n pixels centred on a site.

    North is up, and the projection is azimuthal equidistant around the site.
    """
    import rasterio

    centre = f"+lat_0={latitude_deg!r} +lon_0={longitude_deg!r}"
    return {
        "driver": "GTiff",
        "width": n,
        "height": n,
        "count": n_bands,
        "dtype": "float32",
        "crs": f"+proj=aeqd {centre} +R={MOON_RADIUS_M:.0f} +units=m +no_defs",
        "transform": rasterio.Affine(pixel_m, 0, -n / 2 * pixel_m, 0, -pixel_m, n / 2 * pixel_m),
        "compress": "deflate",
        "predictor": 3,
    }


def export_raster(scene: Scene, path: Path, pixel_m: float) -> None:
    """Write heights above the site, metres, as a float32 GeoTIFF.

    Pixels are square, north is up, and the projection is azimuthal equidistant around the site. Raises UserError unless
    each side has 1 to 20,000 pixels.
    """
    import rasterio

    n = int(np.floor(scene.grid.extent_m / pixel_m))
    if not 1 <= n <= _LARGEST_SIDE:
        raise UserError(path, "pixel size", f"{pixel_m} m, which makes {n} pixels per side", f"1 to {_LARGEST_SIDE}")
    centre = (np.arange(n) + 0.5 - n / 2) * pixel_m
    # O_L's x points west and y south; a raster's columns go east and its rows south.
    profile = site_profile(scene.latitude_deg, scene.longitude_deg, n, pixel_m, 1)
    with written_aside(path) as aside, rasterio.open(aside, "w", **profile) as raster:
        for top in range(0, n, _ROWS_AT_ONCE):
            rows = centre[top : top + _ROWS_AT_ONCE]
            height = value_at(scene.height_m, scene.grid, -centre[None, :], rows[:, None])
            raster.write(height.astype(np.float32), 1, window=rasterio.windows.Window(0, top, n, len(rows)))
        raster.set_band_description(1, "height above the site, m")
