"""The plan: every scene, trajectory and frame of a dataset, fixed before rendering.

The plan depends on the configuration alone. A scene is planned as a seed, which determines its craters and boulders
(`perilune_render.terrain.scene.grow_scene`). The trajectories of a scene are derived from its seed on demand, and a
flight is drawn at its first use. A plan of many millions of frames is therefore made in seconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from perilune_render.config.dataset import DatasetConfig, KindConfig, SunConfig
from perilune_render.flight.rig import MountedCamera, Rig, rig_of
from perilune_render.flight.trajectories import Flight, fly
from perilune_render.flight.view import rig_envelope
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_shared.dataset.names import SPLITS, frame_id_of, trajectory_of_camera
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, sun_direction


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """A scene: one terrain with one direction of the Sun."""

    scene_id: str
    """Id, unique in the dataset."""
    seed: int
    """Random seed of the scene."""
    sun_azimuth_deg: float
    """Azimuth of the Sun, clockwise from north, degrees."""
    sun_elevation_deg: float
    """Elevation of the Sun above the ground plane, degrees."""

    @property
    def sun(self) -> Array:
        """Unit vector towards the Sun, O_L (3,)."""
        return sun_direction(self.sun_azimuth_deg, self.sun_elevation_deg)


@dataclass(frozen=True)
class TrajectoryPlan:
    """One trajectory."""

    scene_id: str
    """Id of the trajectory's scene."""
    trajectory_id: str
    """Id, unique in the scene."""
    seed: int
    """Random seed of the trajectory."""
    frame_index: Sequence[int]
    """Index of each frame in the trajectory, from 0; with gaps if only some of its frames are selected."""
    splits: tuple[str, ...]
    """Split of each frame."""
    draw_flight: Callable[[], Flight]
    """Draws and returns the flight."""
    is_drawn: bool = True
    """Whether the flight follows from the seed; False for flights from a manifest or a pose file, and for surveys."""
    camera: str | None = None
    """Name of the camera if the body has several; None for a single camera without a name."""
    origin: Callable[[int], str] | None = None
    """Function from an index of `frame_index` to the pose's location in a user's file, for messages; None without a
    file."""

    @cached_property
    def flight(self) -> Flight:
        """True motion of the camera, drawn at its first use."""
        return self.draw_flight()

    def frame_id(self, index: int) -> str:
        """Id, unique in the dataset, of the frame at an index of `frame_index`."""
        return frame_id_of(self.scene_id, self.trajectory_id, self.frame_index[index])

    @property
    def split(self) -> str | None:
        """The split of the trajectory, or None if its frames are in several splits."""
        return self.splits[0] if len(set(self.splits)) == 1 else None


@dataclass(frozen=True, slots=True)
class Plan:
    """A dataset before rendering."""

    rig: Rig
    """Cameras by name. Each trajectory belongs to one camera: a descent seen by two cameras makes two trajectories."""
    view: ViewEnvelope
    """The views for which the mesh of every scene is made."""
    scenes: tuple[ScenePlan, ...]
    """All scenes."""
    trajectories: Sequence[TrajectoryPlan]
    """All trajectories, in the order of their scenes. A drawn plan builds a trajectory at each access."""
    ranges: Mapping[str, range]
    """For each scene id, the indices of its trajectories in `trajectories`."""

    @property
    def first(self) -> MountedCamera:
        """The only camera, or the first of several."""
        return next(iter(self.rig.values()))

    @property
    def camera(self) -> Camera:
        """Camera of the frames; the first of several."""
        return self.first.camera

    @property
    def exr_camera(self) -> Camera:
        """Camera of the rendering and the EXRs: a pinhole that covers the view of `camera`."""
        return self.first.exr_camera

    def of_scene(self, scene_id: str) -> list[TrajectoryPlan]:
        """The trajectories of one scene; empty if the plan has no such scene."""
        return [self.trajectories[index] for index in self.ranges.get(scene_id, ())]


@dataclass(frozen=True, slots=True)
class _Drawn(Sequence[TrajectoryPlan]):
    """The trajectories of a configuration, each of which is built when it is accessed."""

    settings: KindConfig
    """Settings of the dataset."""
    kind: str
    """`detect` or `nav`."""
    scenes: tuple[ScenePlan, ...]
    """All scenes."""
    rig: Rig
    """Cameras by name; each camera sees every descent."""
    splits: np.ndarray
    """Index in SPLITS of each frame's split (n_scenes, trajectories_per_scene, n_frames) int8."""

    def __len__(self) -> int:
        return len(self.scenes) * len(self.rig) * self.settings.trajectories_per_scene

    def __getitem__(self, index: Any) -> Any:
        """The trajectory at an index, or the trajectories of a slice as a tuple."""
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        # The descents are grouped by camera, so that each camera of a scene opens only one engine.
        nth, t = divmod(range(len(self))[index], self.settings.trajectories_per_scene)
        s, c = divmod(nth, len(self.rig))
        scene, n_frames = self.scenes[s], self.settings.n_frames
        seed = derived_seed(scene.seed, self.kind, "trajectory", t)
        splits = tuple(SPLITS[code] for code in self.splits[s, t])
        draw_flight = partial(fly, self.settings.flight, n_frames, seed)
        trajectory = TrajectoryPlan(scene.scene_id, f"trajectory-{t:04d}", seed, range(n_frames), splits, draw_flight)
        return seen_by(trajectory, list(self.rig)[c], self.rig)


def seen_by(body: TrajectoryPlan, name: str | None, rig: Rig) -> TrajectoryPlan:
    """The trajectory of a camera on a body.

    A camera without a name has the trajectory of the body.
    """
    if name is None:
        return body
    trajectory_id = trajectory_of_camera(name, body.trajectory_id)
    return replace(body, trajectory_id=trajectory_id, camera=name, draw_flight=partial(_seen, body, rig[name]))


def _seen(body: TrajectoryPlan, camera: MountedCamera) -> Flight:
    return camera.flight_of(body.flight)


def drawn_scene(config: DatasetConfig, sun: SunConfig, ground: str, number: int) -> ScenePlan:
    """The plan of a scene.

    Its seed is derived from the seed and name of the configuration, from `ground`, and from the scene's `number`.
    """
    seed = derived_seed(config.seed, config.name, ground, "scene", number)
    drawn = stream(seed, "sun")
    azimuth = drawn.uniform(sun.azimuth_deg.low, sun.azimuth_deg.high)
    elevation = drawn.uniform(sun.elevation_deg.low, sun.elevation_deg.high)
    return ScenePlan(f"scene-{number:04d}", seed, float(azimuth), float(elevation))


def make_plan(config: DatasetConfig, kind: str) -> Plan:
    """The plan of the dataset `detect` or `nav`. Raises UserError if a distortion is too strong.

    Seeds are derived from the configuration's seed, its name and the kind. Presets therefore share no terrain, and the
    two kinds of one preset share terrain only with `shared_terrain`.
    """
    settings = config.kind(kind)
    rig = rig_of(config)
    splits = _splits(settings, stream(config.seed, config.name, kind, "splits"))
    ground = "shared" if config.shared_terrain else kind
    scenes = [drawn_scene(config, settings.sun, ground, s) for s in range(settings.n_scenes)]
    n = settings.trajectories_per_scene * len(rig)
    ranges = {scene.scene_id: range(s * n, (s + 1) * n) for s, scene in enumerate(scenes)}
    view = rig_envelope(rig, config.ground_flight(kind))
    return Plan(rig, view, tuple(scenes), _Drawn(settings, kind, tuple(scenes), rig, splits), ranges)


def _splits(settings: KindConfig, rng: np.random.Generator) -> np.ndarray:
    """Splits as indices in SPLITS (n_scenes, trajectories_per_scene, n_frames) int8.

    `split_by` states whether all frames of a scene, or all frames of a trajectory, are in the same split.
    """
    shape = (settings.n_scenes, settings.trajectories_per_scene, settings.n_frames)
    n_axes = ("scene", "trajectory", "frame").index(settings.split_by) + 1
    n_units = int(np.prod(shape[:n_axes]))
    largest = n_units if settings.test_share == 1 else max(n_units - 2, 0)
    n_test = min(int(np.ceil(settings.test_share * n_units)), largest)
    n_val = min(int(np.ceil(settings.val_share * n_units)), max(n_units - n_test - 1, 0))
    counts = {"train": n_units - n_val - n_test, "val": n_val, "test": n_test}
    codes = np.repeat(np.array([SPLITS.index(name) for name in counts], np.int8), list(counts.values()))
    return np.broadcast_to(rng.permutation(codes).reshape(shape[:n_axes] + (1,) * (3 - n_axes)), shape)
