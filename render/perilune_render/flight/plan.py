"""The plan: every scene, trajectory and frame of a dataset, fixed before rendering.

The plan depends on the configuration alone. A scene is planned as a seed, which determines its craters and boulders
(`perilune_render.terrain.scene.grow_scene`). The trajectories of a scene are derived from its seed when they are asked
for, and a flight is drawn when it is first used, so that the plan of many millions of frames is made in seconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from perilune_render.config import CameraConfig, DatasetConfig, KindConfig, SunConfig
from perilune_render.flight.trajectories import Flight, fly
from perilune_render.flight.view import view_envelope
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_shared.dataset.names import SPLITS, frame_id_of
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, sun_direction

_LARGEST_COVER = 9
"""Largest ratio of rendered pixels to the camera's pixels."""


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """A scene: one terrain with one direction of the Sun."""

    scene_id: str
    """Unique in the dataset."""
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
    """Scene it belongs to."""
    trajectory_id: str
    """Unique in its scene."""
    seed: int
    """Random seed of the trajectory."""
    frame_index: Sequence[int]
    """Index of each frame in the trajectory, from 0; with gaps if only some of its frames are selected."""
    splits: tuple[str, ...]
    """Split of each frame."""
    draw_flight: Callable[[], Flight]
    """Returns the flight."""
    is_drawn: bool = True
    """Whether the flight follows from the seed; otherwise it is recorded in a manifest."""

    @cached_property
    def flight(self) -> Flight:
        """True motion of the camera, drawn when it is first used."""
        return self.draw_flight()

    def frame_id(self, place: int) -> str:
        """Id, unique in the dataset, of the frame at index `place` of `frame_index`."""
        return frame_id_of(self.scene_id, self.trajectory_id, self.frame_index[place])

    @property
    def split(self) -> str | None:
        """The split of the trajectory, or None if its frames are in several splits."""
        return self.splits[0] if len(set(self.splits)) == 1 else None


@dataclass(frozen=True, slots=True)
class Plan:
    """A dataset before rendering."""

    camera: Camera
    """Camera of all frames."""
    exr_camera: Camera
    """Camera of the rendering and the EXRs: a pinhole that covers the view of `camera`."""
    view: ViewEnvelope
    """The views that the mesh of every scene is made for."""
    scenes: tuple[ScenePlan, ...]
    """All scenes."""
    trajectories: Sequence[TrajectoryPlan]
    """All trajectories, in the order of their scenes. A drawn plan makes a trajectory anew at each access."""
    places: Mapping[str, range]
    """Indices in `trajectories` of the trajectories of each scene, by its id."""

    def of_scene(self, scene_id: str) -> list[TrajectoryPlan]:
        """The trajectories of one scene; none if the plan has no such scene."""
        return [self.trajectories[place] for place in self.places.get(scene_id, ())]


@dataclass(frozen=True, slots=True)
class _Drawn(Sequence[TrajectoryPlan]):
    """The trajectories of a configuration."""

    settings: KindConfig
    """Settings of the dataset."""
    kind: str
    """`detect` or `nav`."""
    scenes: tuple[ScenePlan, ...]
    """All scenes."""
    splits: np.ndarray
    """Index in SPLITS of each frame's split (n_scenes, trajectories_per_scene, n_frames) int8."""

    def __len__(self) -> int:
        return len(self.scenes) * self.settings.trajectories_per_scene

    def __getitem__(self, place: Any) -> Any:
        """The trajectory at an index, or a tuple of those in a slice."""
        if isinstance(place, slice):
            return tuple(self[k] for k in range(*place.indices(len(self))))
        s, t = divmod(range(len(self))[place], self.settings.trajectories_per_scene)
        scene, n_frames = self.scenes[s], self.settings.n_frames
        seed = derived_seed(scene.seed, self.kind, "trajectory", t)
        splits = tuple(SPLITS[code] for code in self.splits[s, t])
        draw_flight = partial(fly, self.settings.flight, n_frames, seed)
        return TrajectoryPlan(scene.scene_id, f"trajectory-{t:04d}", seed, range(n_frames), splits, draw_flight)


def camera_of(config: CameraConfig) -> Camera:
    """The camera of a configuration. Raises UserError if its distortion is too strong.

    Too strong means that it folds back within the image, or that the pinhole that covers the view has more than
    _LARGEST_COVER times the camera's pixels.
    """
    width, height, lens = config.width_px, config.height_px, config.distortion
    focal = config.focal_length_px or width / 2 / np.tan(np.radians(config.horizontal_fov_deg) / 2)
    camera = Camera(
        width,
        height,
        float(focal),
        float(focal),
        width / 2 if config.principal_x_px is None else config.principal_x_px,
        height / 2 if config.principal_y_px is None else config.principal_y_px,
        (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3),
    )
    if camera.folds_back():
        raise UserError(
            "configuration",
            "dataset.camera.distortion",
            camera.distortion,
            "a distortion that does not fold back within the image: weaker, or a narrower view",
        )
    covering = camera.covering_pinhole()
    if covering.width_px * covering.height_px > _LARGEST_COVER * width * height:
        raise UserError(
            "configuration",
            "dataset.camera.distortion",
            camera.distortion,
            f"a weaker one (this one needs a rendering of {covering.width_px} x {covering.height_px} pixels)",
        )
    return camera


def drawn_scene(config: DatasetConfig, sun: SunConfig, ground: str, number: int) -> ScenePlan:
    """The plan of a scene: its seed is derived from the configuration's seed and name, `ground` and the number."""
    seed = derived_seed(config.seed, config.name, ground, "scene", number)
    drawn = stream(seed, "sun")
    azimuth = drawn.uniform(sun.azimuth_deg.low, sun.azimuth_deg.high)
    elevation = drawn.uniform(sun.elevation_deg.low, sun.elevation_deg.high)
    return ScenePlan(f"scene-{number:04d}", seed, float(azimuth), float(elevation))


def make_plan(config: DatasetConfig, kind: str) -> Plan:
    """The plan of the dataset `detect` or `nav`. Raises UserError if the distortion is too strong.

    Seeds are derived from the configuration's seed, its name and the kind. Presets therefore share no terrain. The
    two kinds of one preset share it only with `shared_terrain`.
    """
    settings = config.kind(kind)
    camera = camera_of(config.camera)
    splits = _splits(settings, stream(config.seed, config.name, kind, "splits"))
    ground = "shared" if config.shared_terrain else kind
    scenes = [drawn_scene(config, settings.sun, ground, s) for s in range(settings.n_scenes)]
    n = settings.trajectories_per_scene
    places = {scene.scene_id: range(s * n, (s + 1) * n) for s, scene in enumerate(scenes)}
    exr_camera = camera.covering_pinhole()
    view = view_envelope(exr_camera, config.ground_flight(kind))
    return Plan(camera, exr_camera, view, tuple(scenes), _Drawn(settings, kind, tuple(scenes), splits), places)


def _splits(settings: KindConfig, rng: np.random.Generator) -> np.ndarray:
    """Splits as indices in SPLITS (n_scenes, trajectories_per_scene, n_frames) int8.

    A unit of `split_by` is never divided.
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
