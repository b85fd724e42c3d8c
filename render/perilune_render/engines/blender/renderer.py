"""Rendering with Cycles: settings, and one frame at a time through a temporary EXR."""

import contextlib
import errno
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import bpy
import numpy as np

from perilune_render.config.dataset import DatasetConfig, LightConfig, RenderConfig
from perilune_render.engines.blender import stage as blender_stage
from perilune_render.engines.blender.devices import use_device
from perilune_render.flight.sub_poses import RowPoses
from perilune_render.imaging.exr import read_exr
from perilune_render.imaging.radiance import Radiance
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.level_ground import on_level
from perilune_render.terrain.levels import Level, cut_levels, level_index
from perilune_render.terrain.scene import Scene
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array
from perilune_shared.threads import usable_cores

_FAR_M = 1e9
BAND_PX = 0.2
"""Largest image motion between neighbouring bands of rows, pixels. All rows of a band are rendered from one pose."""
_MIN_FREE_BYTES = 16_000_000
_LIT = 1e-4
"""Direct light above which a pixel counts as sunlit. Earthshine is also direct light, but it is weaker."""


_open: weakref.WeakSet["Renderer"] = weakref.WeakSet()
"""Open renderers of this process."""


class Renderer:
    """Renders frames of one scene with Cycles; an `Engine` of `perilune_render.engines.frame_source`.

    Use a Renderer as a context manager: it holds a temporary folder and Blender's only scene. `camera` has no
    distortion, `sun` (3,) is the unit vector towards the Sun, O_L.

    If the ground is too large for one mesh, each trajectory has several meshes, its levels
    (`perilune_render.terrain.levels`). The height of the camera determines the level that a frame shows. Blender holds
    the mesh of one level at a time, so render frames in an order with few changes of level.

    Raises RuntimeError if another Renderer is open in this process, since Blender holds only one scene.
    """

    def __init__(self, scene: Scene, config: DatasetConfig, camera: Camera, sun: Array):
        self.camera, self.sun = camera, sun
        if _open:
            raise RuntimeError(
                "another Renderer is open in this process; close it first, since Blender holds only one scene"
            )
        _open.add(self)
        try:
            self._build(scene, config, camera, sun)
        except BaseException:
            _open.discard(self)
            raise

    def _build(self, scene: Scene, config: DatasetConfig, camera: Camera, sun: Array) -> None:
        self._scene, self._config = scene, config
        self._exact = config.render.exr
        self._levels: tuple[int, tuple[Level, ...]] | None = None
        self._shown: tuple[int, int] | None = None
        self._in_levels = scene.view is not None and scene.grid.n_vertices > config.terrain.max_vertices
        if not self._in_levels:
            self._stage_with(scene)
        self._folder = tempfile.TemporaryDirectory(prefix="perilune-")

    def _stage_with(self, ground: Scene) -> None:
        """Build the stage with a single mesh."""
        self.stage = blender_stage.build(ground, self._config, self.camera, self.sun)
        configure(self.stage, self.camera, self._config.render, self._config.light)

    def _show_level(self, view: ViewEnvelope, approach_deg: int, z_m: float) -> None:
        """Build the stage with a trajectory's level for a height of the camera, unless it is already shown."""
        terrain = self._config.terrain
        if self._levels is None or self._levels[0] != approach_deg:
            self._levels = approach_deg, cut_levels(terrain, view, approach_deg)
        levels = self._levels[1]
        level = approach_deg, level_index(levels, z_m)
        if level != self._shown:
            self._shown = None
            blender_stage.clear()  # frees the previous mesh before the next is sampled
            self._stage_with(on_level(self._scene, levels[level[1]].grid, terrain.boulders))
            self._shown = level

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the temporary folder and release Blender for another Renderer.

        After this, `render` raises RuntimeError.
        """
        self._folder.cleanup()
        _open.discard(self)

    def render(
        self, position_m: Array, rotation_camera_from_site: Array, seed: int = 0, approach_deg: int = 0
    ) -> Radiance:
        """Render one frame: mean radiance factor of each pixel, and depth of the ray through its centre.

        With dataset.render.exr, the ray through the centre also gives the normal. Otherwise, the normal is the mean
        over the pixel's samples. `approach_deg` is `Shot.approach_deg`. Raises OSError if Blender wrote no readable
        frame, and RuntimeError if the Renderer is closed.
        """
        with self._rendering(float(position_m[2]), approach_deg) as path:
            blender_stage.aim(self.stage, position_m, rotation_camera_from_site)
            return self._through(path, seed)

    def render_rows(self, poses: RowPoses, seed: int = 0, approach_deg: int = 0) -> Radiance:
        """Render one frame with a rolling shutter, in bands of rows with one pose each.

        There are enough bands that the image moves by at most BAND_PX between neighbouring bands, but no more bands
        than rows. Depth is along the camera's axis at the band's pose. Raises the errors of `render`.
        """
        middle = poses.pose_at(0.0)
        with self._rendering(float(middle[0][2]), approach_deg) as path:
            blender_stage.aim(self.stage, *middle)
            with one_ray_a_pixel(self.stage):
                whole = render_through(path, self.stage, seed)
            motion_px = poses.motion_px(whole.depth_m, self.camera)
            for pixels, pose in poses.bands(min(int(motion_px / BAND_PX) + 1, len(poses.time_s))):
                rows = np.flatnonzero(pixels.any(axis=1))
                if not len(rows):
                    continue
                first, last = int(rows[0]), int(rows[-1]) + 1
                blender_stage.aim(self.stage, *pose)
                with rows_only(self.stage, first, last, self.camera.height_px):
                    band = self._through(path, seed)
                in_band = pixels[first:last]
                for name in ("radiance_factor", "depth_m", "normal", "sunlit"):
                    getattr(whole, name)[first:last][in_band] = getattr(band, name)[in_band]
            return whole

    def _through(self, path: Path, seed: int) -> Radiance:
        """Render the stage in its current state."""
        radiance = render_through(path, self.stage, seed)
        if not self._exact:
            return radiance
        with one_ray_a_pixel(self.stage):
            centre = render_through(path, self.stage, seed)
        return replace(radiance, depth_m=centre.depth_m, normal=centre.normal)

    @contextlib.contextmanager
    def _rendering(self, z_m: float, approach_deg: int) -> Iterator[Path]:
        """Show the level for a camera height, and yield the path of the EXR.

        Raises OSError if Blender cannot write the EXR.
        """
        if self not in _open:
            raise RuntimeError("this Renderer is closed")
        if self._in_levels and self._scene.view is not None:
            self._show_level(self._scene.view, approach_deg, z_m)
        path = Path(self._folder.name) / "frame.exr"
        try:
            with interrupts_held():
                yield path
        except (UserError, RuntimeError) as error:
            # Blender reports a failed write only in its log, and the file is then missing or truncated.
            full = shutil.disk_usage(path.parent).free < _MIN_FREE_BYTES
            raise OSError(errno.ENOSPC if full else errno.EIO, f"no frame ({error})", str(path.parent)) from None


def render_through(path: Path, stage: bpy.types.Scene, seed: int) -> Radiance:
    """Render a configured stage into an EXR file and read it."""
    stage.cycles.seed = seed & 0x7FFFFFFF
    stage.render.filepath = str(path)
    path.unlink(missing_ok=True)
    with quiet():
        bpy.ops.render.render(write_still=True)
    return _radiance(path)


@contextlib.contextmanager
def rows_only(stage: bpy.types.Scene, first: int, last: int, n_rows: int) -> Iterator[None]:
    """Configure a stage to render rows `first` to `last` (excluded) of `n_rows`, counted from the top."""
    render = stage.render
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x = 0.0, 1.0
    render.border_min_y, render.border_max_y = 1 - last / n_rows, 1 - first / n_rows
    try:
        yield
    finally:
        render.use_border = render.use_crop_to_border = False


@contextlib.contextmanager
def one_ray_a_pixel(stage: bpy.types.Scene) -> Iterator[None]:
    """Configure a stage for one ray through each pixel's centre, to within 1e-5 px, in the block.

    For any seed, Cycles puts the first sample of a pixel at the centre of the pixel filter. It reads this position from
    a table, which is off by 5e-4 px for a box filter one pixel wide. A narrower filter is more accurate. Cycles ignores
    `filter_width` for the box filter, so a narrow Gaussian is used.
    """
    narrow = {"samples": 1, "pixel_filter_type": "GAUSSIAN", "filter_width": 0.01}
    before = {name: getattr(stage.cycles, name) for name in narrow}
    try:
        for name, value in narrow.items():
            setattr(stage.cycles, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(stage.cycles, name, value)


def configure(stage: bpy.types.Scene, camera: Camera, settings: RenderConfig, light: LightConfig) -> None:
    """Configure Cycles: direct light and at most one bounce, linear float32.

    The acceleration structure is kept between frames. A bounce traces one random ray per sample, so the light in
    shadows is noisy with few samples. Raises UserError without the device of the settings.
    """
    render, cycles = stage.render, stage.cycles
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = (
        camera.width_px,
        camera.height_px,
        100,
    )
    render.pixel_aspect_x, render.pixel_aspect_y = _pixel_aspect(camera)
    render.use_persistent_data = True
    render.use_file_extension = False
    # By default, Blender uses the cores that were available when bpy was imported: a single core (`_one_core`).
    render.threads_mode = "FIXED"
    render.threads = settings.threads or usable_cores()
    render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
    render.image_settings.color_depth = "32"
    render.image_settings.exr_codec = "NONE"
    render.film_transparent = False
    use_device(stage, settings.cycles_device)
    cycles.samples = settings.samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = cycles.diffuse_bounces = int(light.bounce)
    cycles.use_light_tree = False
    # Cycles drops contributions below this threshold at random. At the default of 0.01, most ground would lose its
    # sunlight when the Sun is low.
    cycles.light_sampling_threshold = 0.0
    cycles.pixel_filter_type = "BOX"
    # A box is always one pixel wide: the sensor model applies its point spread later.
    cycles.filter_width = 1.0
    stage.view_settings.view_transform = "Raw"
    layer = stage.view_layers[0]
    layer.use_pass_z = True
    layer.use_pass_normal = True
    layer.use_pass_diffuse_direct = light.bounce or light.earthshine


def _pixel_aspect(camera: Camera) -> tuple[float, float]:
    ratio = camera.fx_px / camera.fy_px
    return (1.0, ratio) if ratio >= 1 else (1.0 / ratio, 1.0)


def _radiance(path: Path) -> Radiance:
    channels = read_exr(path)
    by_pass = {name.split(".", 1)[1]: pixels for name, pixels in channels.items() if "." in name}
    depth = by_pass["Depth.Z"].astype(np.float32)
    # Cycles averages normals over the pixel's samples, which shortens them at edges; sky pixels have no normal.
    normal = np.stack([by_pass[f"Normal.{axis}"] for axis in "XYZ"], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    radiance_factor = by_pass["Combined.R"]
    # If there is other light than the Sun's, use the pass of direct light. Cycles has divided it by the surface colour.
    sunlit = by_pass.get("DiffDir.R", radiance_factor) > _LIT
    return Radiance(radiance_factor, np.where(depth > _FAR_M, np.float32(np.inf), depth), normal, sunlit)


class quiet:
    """Context manager that discards what Blender prints to file descriptor 1."""

    def __enter__(self) -> None:
        self._saved = os.dup(1)
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1)
        os.close(sink)

    def __exit__(self, *_: object) -> None:
        os.dup2(self._saved, 1)
        os.close(self._saved)
