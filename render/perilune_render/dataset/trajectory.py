"""Render one trajectory: its images, labels and rows of `frames`."""

from collections.abc import Callable
from pathlib import Path

from perilune_render.config import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame_files import write_frame
from perilune_render.dataset.real_ground import real_ground_share
from perilune_render.dataset.shots import planned_shot
from perilune_render.dataset.trajectory_parts import finish_trajectory
from perilune_render.flight.plan import TrajectoryPlan
from perilune_render.frame_source import FrameSource
from perilune_render.imaging.darkness import is_dark
from perilune_render.terrain.scene import Scene


def render_trajectory(
    out: Path,
    source: FrameSource,
    trajectory: TrajectoryPlan,
    scene: Scene,
    config: DatasetConfig,
    advance: Callable[[], object] = lambda: None,
) -> list[str]:
    """Render and write one trajectory of `scene` into the dataset's folder `out`; returns the ids of its dark frames.

    `source` renders the scene. `advance` is called after each frame. The same arguments give the same bytes; a
    trajectory whose rendering was interrupted is rendered from its start.
    """
    rows: list[dict] = []
    labels, dark = [], []
    for place in range(len(trajectory.splits)):
        frame_id, frame = trajectory.frame_id(place), source.take(planned_shot(trajectory, place))
        files = write_frame(out, frame_id, source, frame, exr=config.render.exr)
        share = real_ground_share(scene, source.engine.camera, *frame.shot.pose, frame.radiance.depth_m)
        found = source.labels(frame)
        rows.append({**files, "real_ground_share": share, "n_craters_above_max_radius": found.n_above})
        labels.append(tables.label_table(frame_id, found))
        if is_dark(frame.radiance):
            dark.append(frame_id)
        advance()
    frames = tables.frame_table(trajectory, source.camera, source.engine.sun, rows)
    finish_trajectory(out, trajectory.scene_id, trajectory.trajectory_id, labels, frames)
    return dark
