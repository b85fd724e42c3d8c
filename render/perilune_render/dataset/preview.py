"""A contact sheet of a configuration, to see the effect of a setting quickly."""

from pathlib import Path

import numpy as np

from perilune_render.blender.renderer import Renderer
from perilune_render.config import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame import Shot, Studio
from perilune_render.dataset.real_ground import draw_outline, outline_m
from perilune_render.flight.plan import make_plan
from perilune_render.flight.pose_checks import Poses, check_poses
from perilune_render.imaging.darkness import is_dark, warn_of_dark_frames
from perilune_render.imaging.sensor import FixedPattern
from perilune_render.labels.drawing import draw_labels, enlarge, write_sheet
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.elevation.model import read_elevation
from perilune_render.terrain.scene import check_ground
from perilune_shared.dataset.selection import selected
from perilune_shared.dataset.thresholds import SELECTIONS
from perilune_shared.geometry.frames import sun_direction


def write_preview(config: DatasetConfig, kind: str, path: Path, n_frames: int = 4) -> None:
    """Write a contact sheet of the first scene and trajectory: frames evenly spaced in time, and below with labels.

    The lower row also shows the outline of the elevation model, if there is one.
    """
    plan = make_plan(config, kind)
    scene_plan, trajectory = plan.scenes[0], plan.trajectories[0]
    check_ground(config, plan.view)
    scene = cached_scene(config, plan.view, scene_plan.seed)
    check_poses(Poses.planned([trajectory]), plan.exr_camera, scene, f"configuration: dataset.{kind}")
    sun = sun_direction(scene_plan.sun_azimuth_deg, scene_plan.sun_elevation_deg)
    pattern = FixedPattern.draw(config.sensor, plan.camera, config.seed)
    studio = Studio(config, plan.camera, plan.exr_camera, pattern, RimCircles.of_scene(scene), sun)
    depth_m, diameter_m = scene.rims.depth_m, scene.craters.diameter_m
    outline = None if config.terrain.dem is None else outline_m(read_elevation(Path(config.terrain.dem)))
    plain, drawn, dark = [], [], []
    with Renderer(scene, config, plan.exr_camera, sun) as renderer:
        for index in np.linspace(0, len(trajectory.splits) - 1, n_frames).astype(int):
            shot = Shot.planned(trajectory, index)
            radiance = renderer.render(shot.position_m, shot.rotation_camera_from_site, seed=shot.render_seed)
            image, exposure = studio.take(shot, radiance)
            labels = studio.label(shot, radiance, exposure)
            rows = tables.label_table(shot.frame_id, labels).to_pandas()
            rows = rows.assign(depth_m=depth_m[labels.crater_id], diameter_m=diameter_m[labels.crater_id])
            grey = image if config.sensor.bits == 8 else (image >> (config.sensor.bits - 8)).astype(np.uint8)
            plain.append(enlarge(grey, 2))
            drawn.append(draw_labels(grey, labels, selected(rows, SELECTIONS["visible"])))
            if outline is not None:
                pose = shot.position_m, shot.rotation_camera_from_site
                draw_outline(drawn[-1], outline, scene, plan.camera, *pose)
            if is_dark(radiance):
                dark.append(shot.frame_id)
    warn_of_dark_frames(scene_plan.scene_id, dark, n_frames, scene_plan.sun_elevation_deg)
    write_sheet(path, plain + drawn, n_frames)
