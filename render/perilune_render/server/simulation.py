"""A scene that can be rendered from any pose and measured with rays. Only one thread may use it."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.config.scene import SceneConfig
from perilune_render.dataset.tables import ground_tables
from perilune_render.engines.frame_source import Frame, FrameSource, Shot
from perilune_render.engines.heightfield.query import first_hits, heights_m
from perilune_render.engines.heightfield.surface import Surface, surface_of
from perilune_render.engines.open_engine import check_engine, open_engine
from perilune_render.flight.lens import camera_of
from perilune_render.flight.pose_checks import LARGEST_MPS, LARGEST_RADPS, Poses, check_places, check_poses
from perilune_render.flight.rig import rig_of
from perilune_render.flight.view import horizon_envelope, scene_view, view_envelope
from perilune_render.imaging.radiance import Radiance
from perilune_render.labels.frame_labels import Labels, RimCircles
from perilune_render.poses.plan import scene_seed
from perilune_render.provenance.versions import device_of
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_render.terrain.scene import Scene, check_ground
from perilune_shared.console.progress import say
from perilune_shared.content import content_sha256
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, quaternion_from_matrix, sun_direction

if TYPE_CHECKING:
    # Without a device, numba's CUDA module is not imported.
    from perilune_render.engines.heightfield.gpu_frames import DeviceFrames

_MAX_SOURCES = 8
_PREPARED_AT_M = 500.0
_DOWN = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class View:
    """A camera, its pose and the Sun."""

    position_m: Array
    """Position, O_L, metres (3,)."""
    rotation_camera_from_site: Array
    """Rotation matrix (3, 3)."""
    camera: Camera
    """Camera."""
    sun: Array
    """Unit vector towards the Sun, O_L (3,)."""


class SimulatedScene:
    """Renders frames of a scene, and casts rays at it. Close it at the end.

    With the engine `cycles`, a change of camera or Sun builds Blender's scene again, which takes seconds.
    """

    def __init__(self, scene: Scene, config: DatasetConfig, note: Callable[[str], object] = lambda text: None):
        self.scene, self.config = scene, config
        self.surface: Surface = surface_of(scene)
        self._circles, self._note = RimCircles.of_scene(scene), note
        self._sources: dict[tuple, tuple[FrameSource, ExitStack]] = {}

    def __enter__(self) -> "SimulatedScene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the engines."""
        for _, stack in self._sources.values():
            stack.close()
        self._sources.clear()

    def prepare(self) -> None:
        """Render and label a frame of the site, so that the first frame of a client does not wait.

        In a new installation, this compiles functions, which takes half a minute on one core.
        """
        stated = self.config.scene or SceneConfig()
        position = np.array([0.0, 0.0, float(self.heights_m(np.zeros(1), np.zeros(1))[0]) + _PREPARED_AT_M])
        sun = sun_direction(stated.sun_azimuth_deg, stated.sun_elevation_deg)
        view = View(position, _DOWN, camera_of(self.config.camera), sun)
        source = self._source(view)
        source.labels(source.take(Shot(view.position_m, view.rotation_camera_from_site, np.zeros(3), 0)))

    @cached_property
    def content_sha256(self) -> str:
        """Content hash of the terrain, as in the table `scenes` of a manifest."""
        tables = ground_tables("scene", self.scene)
        return content_sha256(tables["craters"], tables["boulders"])

    def frame(
        self,
        view: View,
        seed: int,
        index: int,
        velocity_mps: Array | None = None,
        angular_velocity_radps: Array | None = None,
    ) -> Frame:
        """Render and develop a frame, blurred by the velocities.

        Raises UserError like `check_view`, and if a velocity exceeds LARGEST_MPS or LARGEST_RADPS.
        """
        return self.take(view, shot_of(view, seed, index, velocity_mps, angular_velocity_radps))

    def take(self, view: View, shot: Shot) -> Frame:
        """Render and develop the shot of a view. Raises UserError like `check_view`."""
        self.check_view(view)
        return self._source(view).take(shot)

    def on_device(self, views: Sequence[View], shots: Sequence[Shot]) -> "tuple[DeviceFrames, list[Labels]] | None":
        """Render and label a batch of frames in the memory of the CUDA device; all views have one camera and one Sun.

        Returns None if the processor must make the frames (`gpu_frames.CudaSource.fits`). Raises UserError like
        `check_view`.
        """
        if device_of(self.config.render) != "cuda":
            return None
        from perilune_render.engines.heightfield.gpu_frames import CudaSource

        source = self._source(views[0])
        if not CudaSource.fits(source):
            return None
        for view in views:
            self.check_view(view)
        on_device = CudaSource(source)
        frames = on_device.take(shots)
        return frames, on_device.labels(frames)

    def labels(self, view: View, frame: Frame) -> Labels:
        """Labels of a frame."""
        return self._source(view).labels(frame)

    def radiance(self, view: View) -> Radiance:
        """Radiance, depth and normals of a view, without a sensor."""
        self.check_view(view)
        return self._source(view).render(Shot(view.position_m, view.rotation_camera_from_site, np.zeros(3), 0))

    def check(self, position_m: Array) -> None:
        """Raise UserError if a camera is beyond the edge of the ground, or not above its surface."""
        check_places(_poses(position_m, _DOWN), self.scene, "request")

    def check_view(self, view: View) -> None:
        """Raise UserError if `perilune-render frames` would reject the view."""
        rendered = view.camera.rendered()
        check_poses(_poses(view.position_m, view.rotation_camera_from_site), rendered, self.scene, "request")

    def hits(self, origins_m: Array, directions: Array, *, boulders: bool = True) -> tuple[Array, Array]:
        """Distances (N,) and normals (N, 3) of the first hits of rays, as from `heightfield.query.first_hits`."""
        return first_hits(self.surface, origins_m, directions, boulders=boulders)

    def heights_m(self, x_m: Array, y_m: Array, *, boulders: bool = True) -> Array:
        """Heights (N,) of the surface, metres; NaN beyond the edge of the ground."""
        return heights_m(self.surface, x_m, y_m, boulders=boulders)

    def _source(self, view: View) -> FrameSource:
        """The frame source for a view's camera and Sun, opened if necessary."""
        key = (view.camera, tuple(view.sun.tolist()))
        source = self._sources.pop(key, None) or self._opened(view)
        self._sources[key] = source  # the most recently used source comes last
        return source[0]

    def _opened(self, view: View) -> tuple[FrameSource, ExitStack]:
        cycles = self.config.render.engine == "cycles"
        most = 1 if cycles else _MAX_SOURCES
        while len(self._sources) >= most:
            self._sources.pop(next(iter(self._sources)))[1].close()
        if cycles:
            self._note("building the scene in Blender for another camera or Sun")
        stack = ExitStack()
        rendered = view.camera.rendered()
        engine = stack.enter_context(
            open_engine(self.scene, self.config, rendered, view.sun, None if cycles else self.surface)
        )
        return FrameSource.of(engine, self.config, view.camera, self._circles), stack


def shot_of(
    view: View, seed: int, index: int, velocity_mps: Array | None, angular_velocity_radps: Array | None = None
) -> Shot:
    """The shot of a view. Raises UserError if a velocity exceeds LARGEST_MPS or LARGEST_RADPS."""
    velocity = _limited(velocity_mps, "velocity_mps", LARGEST_MPS, "m/s")
    turn = _limited(angular_velocity_radps, "angular_velocity_radps", LARGEST_RADPS, "rad/s")
    pose = view.position_m, view.rotation_camera_from_site
    return Shot(*pose, velocity, seed, index, angular_velocity_radps=turn)


def open_simulation(config: DatasetConfig, kind: str = "nav") -> SimulatedScene:
    """The simulated scene of a configuration.

    Its ground covers the views in `dataset.scene.views` or, without them, the flights of the dataset `kind`, detect or
    nav.
    """
    (mounted_camera,) = rig_of(config).values()
    scene = config.scene or SceneConfig()
    if scene.views:
        view = scene_view(scene, mounted_camera.exr_camera)
    elif scene.horizon:
        view = horizon_envelope(mounted_camera.exr_camera, config.ground_flight(kind))
    else:
        view = view_envelope(mounted_camera.levelled(), config.ground_flight(kind))
    return simulation_over(config, view, scene_seed(config))


def simulation_over(config: DatasetConfig, view: ViewEnvelope, seed: int) -> SimulatedScene:
    """The simulated scene of a configuration, with ground of a random seed that covers the given views.

    Raises UserError if the engine is not installed or the ground is too large.
    """
    check_engine(config.render)
    if config.render.engine == "cycles":
        # Use one mesh, since levels fit only one descent. `check_ground` rejects ground that is too large for one mesh.
        view = replace(view, seen=None)
    check_ground(config, view)
    say("generating the ground")
    return SimulatedScene(cached_scene(config, view, seed), config, say)


def _poses(position_m: Array, rotation_camera_from_site: Array) -> Poses:
    """One pose, in the form that the pose checks take."""
    return Poses(["requested"], np.asarray(position_m)[None], quaternion_from_matrix(rotation_camera_from_site)[None])


def _limited(values: Array | None, field: str, largest: float, unit: str) -> Array:
    """The vector `values` (3,), or zeros for None. Raises UserError if it is longer than `largest`."""
    vector = np.zeros(3) if values is None else np.asarray(values, np.float64)
    # Test the components first, since the length of a very large vector overflows.
    if not np.abs(vector).max() <= largest or np.linalg.norm(vector) > largest:
        raise UserError("camera", field, vector.tolist(), f"at most {largest:g} {unit}")
    return vector
