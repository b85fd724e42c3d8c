"""Render one trajectory: write its images, its labels and its rows of the table `frames`."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import pyarrow as pa

from perilune_render.config.dataset import DatasetConfig, InstrumentsConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.real_ground import real_ground_share
from perilune_render.dataset.shots import planned_shot
from perilune_render.dataset.work import commit
from perilune_render.engines.frame_source import Frame, FrameSource, Shot
from perilune_render.flight.plan import TrajectoryPlan
from perilune_render.imaging.darkness import is_dark
from perilune_render.imaging.radiance import Radiance
from perilune_render.outputs.of_scene import SceneOutputs
from perilune_render.terrain.scene import Scene
from perilune_shared.storage.store import Store


@dataclass(frozen=True, slots=True)
class SceneSetting:
    """Data shared by all trajectories of a scene."""

    scene: Scene
    """Ground, craters and boulders."""
    config: DatasetConfig
    """Settings of the dataset."""
    instruments: InstrumentsConfig
    """Instruments on the lander."""
    outputs: SceneOutputs = field(default_factory=SceneOutputs)
    """Additional outputs, such as flash lidar images; none by default."""


@dataclass(frozen=True, slots=True)
class _Written:
    """Table rows of a frame whose files are written."""

    row: dict[str, str | int | float | None]
    """Columns of files and measurements in the table `frames`."""
    labels: pa.Table
    """Rows of the table `labels`."""
    is_dark: bool
    """Whether almost no pixel of the frame is sunlit."""


def render_trajectory(
    out: Store,
    source: FrameSource,
    trajectory: TrajectoryPlan,
    of_scene: SceneSetting,
    advance: Callable[[], object] = lambda: None,
) -> list[str]:
    """Render and write one trajectory into the dataset at `out`; returns the ids of its dark frames.

    `source` renders the scene. A second thread develops, labels and writes each frame while the next one is rendered.
    `advance` is called after each frame, in order. The same arguments give the same bytes.
    """
    frames: list[_Written] = []
    for frame in _frames(out, source, trajectory, of_scene):
        frames.append(frame)
        advance()
    rows = tables.frame_table(trajectory, source.camera, source.engine.sun, [frame.row for frame in frames])
    labels = [frame.labels for frame in frames]
    has_given_poses = of_scene.config.scene is not None
    measured = tables.measurement_tables(trajectory, of_scene.scene, of_scene.instruments, at_frames=has_given_poses)
    commit(out, labels, rows, measured)
    return [trajectory.frame_id(index) for index, frame in enumerate(frames) if frame.is_dark]


def _frames(out: Store, source: FrameSource, trajectory: TrajectoryPlan, of_scene: SceneSetting) -> Iterator[_Written]:
    """Render and write the frames of a trajectory in order. The next frame is rendered while one is written."""

    def written(index: int, shot: Shot, radiance: Radiance) -> _Written:
        frame = source.develop(shot, radiance)
        outputs = of_scene.outputs.of_frame(frame, source.places_m)
        frame_id = trajectory.frame_id(index)
        files = write_frame(out, frame_id, source, frame, exr=of_scene.config.render.exr, outputs=outputs)
        return _labelled(frame_id, files, source, frame, of_scene.scene)

    with ThreadPoolExecutor(1, "develop") as developer:
        last: Future[_Written] | None = None
        for index in range(len(trajectory.splits)):
            shot = planned_shot(trajectory, index)
            radiance = source.render(shot)
            if last is not None:
                yield last.result()
            last = developer.submit(written, index, shot, radiance)
        if last is not None:
            yield last.result()


def _labelled(frame_id: str, files: dict[str, str | int], source: FrameSource, frame: Frame, scene: Scene) -> _Written:
    """Label a frame. `files` holds the columns that describe its written files."""
    share = real_ground_share(scene, source.engine.camera, *frame.shot.pose, frame.radiance.depth_m)
    labels = source.labels(frame)
    row = {**files, "real_ground_share": share, "n_craters_above_max_radius": labels.n_above}
    return _Written(row, tables.label_table(frame_id, labels), is_dark(frame.radiance))
