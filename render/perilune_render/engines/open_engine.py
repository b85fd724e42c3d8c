"""Open the engine of a configuration: `cycles` (Blender) or `heightfield` (ray casting); check that it can be used."""

import contextlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from perilune_render.config.dataset import DatasetConfig, RenderConfig
from perilune_render.engines.frame_source import Engine
from perilune_render.provenance.versions import check_installed, device_of
from perilune_render.terrain.scene import Scene
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.threads import usable_cores

if TYPE_CHECKING:
    from perilune_render.engines.heightfield.surface import Surface


def open_engine(
    scene: Scene, config: DatasetConfig, camera: Camera, sun: Array, surface: "Surface | None" = None
) -> AbstractContextManager[Engine]:
    """The engine of `dataset.render.engine` for a scene lit from `sun` (3,), O_L.

    Use the engine as a context manager. The engine `heightfield` builds the surface of the scene unless `surface` is
    given. Raises UserError if the engine cannot be loaded or cannot render the light of the configuration.
    """
    if device_of(config.render) == "cuda":
        from perilune_render.engines.heightfield.gpu import CudaEngine

        return CudaEngine(scene, config, camera, sun, surface)
    if config.render.engine == "heightfield":
        from perilune_render.engines.heightfield.engine import HeightfieldEngine

        return HeightfieldEngine(scene, config, camera, sun, config.render.threads or usable_cores(), surface)
    check_installed(config.render.engine)
    if camera.lens is not None:
        found = f"cycles with the lens model {camera.model}"
        raise UserError("configuration", "dataset.render.engine", found, "heightfield")
    with _blender_imported():
        # Import Blender only for this engine, since the import takes a second.
        from perilune_render.engines.blender.renderer import Renderer

    return Renderer(scene, config, camera, sun)


def check_engine(render: RenderConfig) -> None:
    """Raise UserError if the engine is not installed or its device does not exist on this machine.

    Imports Blender only for a device of Cycles other than the processor.
    """
    check_installed(render.engine, render.device)
    if render.cycles_device != "cpu":
        with _blender_imported():
            from perilune_render.engines.blender.devices import check_device
        check_device(render.cycles_device)


@contextlib.contextmanager
def _blender_imported() -> Iterator[None]:
    """Raise UserError if the block cannot import Blender's module, which is installed."""
    try:
        yield
    except ImportError as error:
        # The module is installed, so a system library is missing.
        expected = "the X11 libraries that Blender needs; `scripts/system-libraries` lists them"
        raise UserError("configuration", "dataset.render.engine", f"cycles ({error})", expected) from None


def load_engine(name: str) -> None:
    """Import the libraries of an engine before a scene exists.

    `open_engine` later reports a missing library.
    """
    with contextlib.suppress(ImportError):
        if name == "heightfield":
            import perilune_render.engines.heightfield.engine
        else:
            import perilune_render.engines.blender.renderer  # noqa: F401
