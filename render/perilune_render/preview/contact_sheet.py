"""A contact sheet of a configuration and a map of its site, to see the effect of a setting quickly."""

from pathlib import Path

import cv2
import numpy as np

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.real_ground import draw_outline, outline_m
from perilune_render.dataset.shots import planned_shot
from perilune_render.engines.frame_source import FrameSource
from perilune_render.engines.open_engine import check_engine, open_engine
from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.flight.pose_checks import check_trajectories
from perilune_render.imaging.darkness import is_dark, warn_of_dark_frames
from perilune_render.labels.drawing import draw_labels, enlarge, padded, write_sheet
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.preview.map_picture import map_picture
from perilune_render.preview.site_horizon import shadow_warnings, site_horizon_of
from perilune_render.preview.site_map import LARGEST_WIDTH, site_map
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.elevation.model import ElevationModel
from perilune_render.terrain.scene import Scene, check_ground, model_of
from perilune_shared.console.progress import say
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_shared.storage.files import write_bytes

_N_FRAMES = 4
"""Largest number of frames of each camera."""


def write_preview(plan: Plan, config: DatasetConfig, where: object, path: Path, map_path: Path) -> None:
    """Write a contact sheet of the first trajectory in the first scene, and a map of this scene.

    The frames are evenly spaced in time. Each frame is shown twice: without labels, and with labels and the outline of
    the elevation model, if there is one. The map shows all trajectories over the scene's ground. Prints a warning for
    each Sun that leaves the site in shadow. Raises UserError if the engine is not installed or if a pose fails
    `check_poses`; `where` names the source of the poses in the message.
    """
    check_engine(config.render)
    scene_plan = plan.scenes[0]
    trajectories = [next(t for t in plan.of_scene(scene_plan.scene_id) if t.camera == name) for name in plan.rig]
    check_ground(config, plan.view)
    scene = cached_scene(config, plan.view, scene_plan.seed)
    check_trajectories(plan, trajectories, scene, where)
    model = model_of(config.terrain, LARGEST_WIDTH * scene.grid.extent_m)
    horizon = site_horizon_of(scene, scene_plan.sun_azimuth_deg)
    same_ground = [each for each in plan.scenes if each.seed == scene_plan.seed]
    for line in shadow_warnings(scene, same_ground):
        say(line)
    n_frames = min(_N_FRAMES, len(trajectories[0].splits))
    pictures, dark = [], []
    for trajectory in trajectories:
        mounted = plan.rig[trajectory.camera]
        with open_engine(scene, config, mounted.exr_camera, scene_plan.sun) as engine:
            source = FrameSource.of(engine, config, mounted.camera, RimCircles.of_scene(scene), trajectory.camera)
            row, own_dark = _rows(source, trajectory, scene, model, config, n_frames)
        pictures += row
        dark += own_dark
    warn_of_dark_frames(scene_plan.scene_id, dark, n_frames * len(trajectories), scene_plan.sun_elevation_deg)
    if len(trajectories) > 1:
        pictures = padded(pictures, [n_frames] * 2 * len(trajectories), n_frames)
    tracks = [each.flight.position_m for lit in same_ground for each in plan.of_scene(lit.scene_id)]
    site_deg = scene.latitude_deg, scene.longitude_deg
    picture = map_picture(config.name, site_map(scene, model, scene_plan.sun), scene_plan, site_deg, tracks, horizon)
    write_sheet(path, pictures, n_frames)
    write_bytes(map_path, cv2.imencode(".png", picture)[1].tobytes())


def _rows(
    source: FrameSource,
    trajectory: TrajectoryPlan,
    scene: Scene,
    model: ElevationModel | None,
    config: DatasetConfig,
    n_frames: int,
) -> tuple[list[np.ndarray], list[str]]:
    """Pictures of a trajectory's frames, the same frames with labels, and the ids of the dark frames."""
    depth_m, diameter_m = scene.rims.depth_m, scene.craters.diameter_m
    outline = None if model is None else outline_m(model)
    plain, drawn, dark = [], [], []
    for index in np.linspace(0, len(trajectory.splits) - 1, n_frames).astype(int):
        frame_id, frame = trajectory.frame_id(index), source.take(planned_shot(trajectory, index))
        labels = source.labels(frame)
        rows = tables.label_table(frame_id, labels).to_pandas()
        rows = rows.assign(depth_m=depth_m[labels.crater_id], diameter_m=diameter_m[labels.crater_id])
        grey = (frame.image >> (config.sensor.bits - 8)).astype(np.uint8)
        plain.append(enlarge(grey, 2))
        drawn.append(draw_labels(grey, labels, selected(rows, SELECTIONS["visible"])))
        if outline is not None:
            draw_outline(drawn[-1], outline, scene, source.camera, *frame.shot.pose)
        if is_dark(frame.radiance):
            dark.append(frame_id)
    return plain + drawn, dark
