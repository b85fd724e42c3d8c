"""Versions of all that ground, rendering and images follow from: our code by its hash, libraries by their number."""

import functools
from importlib import metadata

import perilune_render
import perilune_shared
from perilune_render.provenance.fingerprint import fingerprint

GROUND = ("perilune_render.terrain.scene:grow_scene",)
"""What makes ground, craters and boulders."""
RENDERING = ("perilune_render.flight.plan:make_plan", "perilune_render.blender.renderer:Renderer")
"""What makes radiance of it along the planned trajectories."""
IMAGING = (
    "perilune_render.imaging.sensor:FixedPattern",
    "perilune_render.dataset.frame:Shot",
    "perilune_render.dataset.frame:Studio",
    "perilune_render.dataset.tables:",
)
"""What makes images, labels and rows of the manifest of that."""
LIBRARIES = {
    "OpenEXR": ("openexr", "OpenEXR"),
    "bpy": ("blender", "bpy"),
    "cv2": ("opencv", "opencv-python-headless"),
    "numba": ("numba", "numba"),
    "numpy": ("numpy", "numpy"),
    "rasterio": ("rasterio", "rasterio"),
    "scipy": ("scipy", "scipy"),
    "trimesh": ("trimesh", "trimesh"),
}
"""Recorded name and distribution of each library that computes, by its import name."""
_NAMES = {"generator": GROUND, "renderer": RENDERING, "imaging": IMAGING}


def ground_versions(*, with_dem: bool) -> dict[str, str]:
    """Of what makes the ground. Elevation models are read by rasterio, which does nothing else."""
    return _versions(("generator",), with_dem)


def imaging_versions() -> dict[str, str]:
    """Of what makes images and labels of EXRs. Needs no Blender."""
    return _versions(("imaging",), False)


def all_versions(*, with_dem: bool) -> dict[str, str]:
    """Of everything that a rendered frame and its labels follow from."""
    return _versions(tuple(_NAMES), with_dem)


@functools.cache
def _found(names: tuple[str, ...]) -> dict[str, str]:
    prints = {name: fingerprint(*_NAMES[name]) for name in names}
    used = frozenset().union(*(each.libraries for each in prints.values()))
    return {
        "perilune_render": perilune_render.__version__,
        "perilune_shared": perilune_shared.__version__,
        **{name: each.sha256[:16] for name, each in prints.items()},
        **{told: metadata.version(distribution) for name, (told, distribution) in LIBRARIES.items() if name in used},
    }


def _versions(names: tuple[str, ...], with_dem: bool) -> dict[str, str]:
    found = dict(_found(names))
    if not with_dem:
        found.pop("rasterio", None)
    return found
