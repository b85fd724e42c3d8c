"""Versions of the code that determines a dataset: hashes of perilune's code, versions of libraries."""

import functools
import importlib.util
from importlib import metadata

import perilune_render
import perilune_shared
from perilune_render.config.dataset import RenderConfig
from perilune_render.provenance import processor
from perilune_render.provenance.caches import kept_fingerprint
from perilune_shared.errors import UserError

_SETTINGS = "perilune_render.provenance.processor:SETTINGS"
GROUND = (
    _SETTINGS,
    "perilune_render.flight.view:rig_envelope",
    "perilune_render.flight.view:scene_view",
    "perilune_render.terrain.scene:grow_scene",
)
"""Code that generates ground, craters and boulders."""
RENDERING = (_SETTINGS, "perilune_render.flight.plan:make_plan", "perilune_render.engines.blender.renderer:Renderer")
"""Code that plans trajectories and renders radiance."""
IMAGING = (
    _SETTINGS,
    "perilune_render.engines.frame_source:",
    "perilune_render.dataset.shots:",
    "perilune_render.dataset.frame_files:frame_contents",
    "perilune_render.dataset.tables:",
    "perilune_render.dataset.real_ground:real_ground_share",
)
"""Code that makes images, labels and manifest rows from radiance."""
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
"""Recorded name and distribution of each library that affects results, by import name."""
RAYS = (*RENDERING[:2], "perilune_render.engines.heightfield.engine:HeightfieldEngine")
"""Code that plans trajectories and renders radiance with the engine `heightfield`."""
RAYS_CUDA = (*RENDERING[:2], "perilune_render.engines.heightfield.gpu:CudaEngine")
"""Code that plans trajectories and renders radiance with the engine `heightfield` on a GPU."""
OUTPUTS = (_SETTINGS, "perilune_render.outputs.of_scene:SceneOutputs", "perilune_render.outputs.hazard:hazard_tiff")
"""Code that makes hazard maps and images of the flash lidar."""
_NAMES = {
    "generator": GROUND,
    "renderer": RENDERING,
    "rays": RAYS,
    "rays_cuda": RAYS_CUDA,
    "imaging": IMAGING,
    "outputs": OUTPUTS,
}
_RECORDED = {"rays": "renderer", "rays_cuda": "renderer"}
"""Names in a recipe of versions that have a different name in this module."""


def ground_versions(*, with_dem: bool) -> dict[str, str]:
    """Versions of the code and libraries that generate the ground.

    rasterio is included only with an elevation model (`with_dem`).
    """
    return _versions(("generator",), with_dem)


def imaging_versions() -> dict[str, str]:
    """Versions of the code and libraries that make images and labels from EXRs; does not need Blender."""
    return _versions(("imaging",), False)


def all_versions(
    *, with_dem: bool, engine: str = "cycles", device: str = "cpu", outputs: bool = False
) -> dict[str, str]:
    """Versions of all code that determines frames and labels, and with `outputs` the additional outputs.

    Raises UserError if the engine is not installed.
    """
    check_installed(engine, device)
    rays = "rays_cuda" if device == "cuda" else "rays"
    names = ("generator", rays if engine == "heightfield" else "renderer", "imaging")
    return _versions((*names, "outputs") if outputs else names, with_dem or outputs)


def device_of(render: RenderConfig) -> str:
    """The device that renders, cpu or cuda; `auto` is cuda if there is a CUDA device."""
    if render.device != "auto":
        return render.device
    return "cuda" if _cuda_found() else "cpu"


def _cuda_found() -> bool:
    # numba looks for the driver, so ask it only for a device that is not the processor.
    from numba import cuda

    return bool(cuda.is_available())


def check_installed(engine: str, device: str = "cpu") -> None:
    """Raise UserError for `cycles` without Blender's module, and for the device `cuda` without a CUDA device."""
    if device == "cuda" and not _cuda_found():
        expected = "cpu or auto, or a GPU of NVIDIA with its driver and `pip install 'perilune-render[cuda]'`"
        raise UserError("configuration", "dataset.render.device", "cuda, but no CUDA device is found", expected)
    if engine == "cycles" and importlib.util.find_spec("bpy") is None:
        found = "cycles, without Blender's module bpy"
        expected = "heightfield, or on Python 3.11 `pip install 'perilune-render[blender]'`"
        raise UserError("configuration", "dataset.render.engine", found, expected)


@functools.cache
def _found(names: tuple[str, ...], with_dem: bool) -> dict[str, str]:
    prints = {name: kept_fingerprint(*_NAMES[name]) for name in names}
    used = frozenset().union(*(each.libraries for each in prints.values()))
    return {
        "perilune_render": perilune_render.__version__,
        "perilune_shared": perilune_shared.__version__,
        **{_RECORDED.get(name, name): each.sha256[:16] for name, each in prints.items()},
        **{
            recorded: metadata.version(distribution)
            for name, (recorded, distribution) in LIBRARIES.items()
            # Without an elevation model, rasterio is not used and need not be installed.
            if name in used and (with_dem or name != "rasterio")
        },
    }


def _versions(names: tuple[str, ...], with_dem: bool) -> dict[str, str]:
    versions = dict(_found(names, with_dem))
    if not processor.IN_FORCE:
        versions["arithmetic"] = "of the processor"
    return versions
