"""One contact sheet of a configuration: for anyone who changes a setting and wants to see what it does."""

from pathlib import Path

import numpy as np

from perilune_render.blender.renderer import Renderer
from perilune_render.config import DatasetConfig
from perilune_render.labels import RimCircles, label_frame
from perilune_render.picture import draw_labels, enlarge, write_sheet
from perilune_render.plan import make_plan
from perilune_render.resample import seen_by
from perilune_render.sensor import FixedPattern, develop
from perilune_render.streams import stream
from perilune_render.terrain.cache import cached_scene
from perilune_shared.frames import sun_direction


def write_preview(config: DatasetConfig, kind: str, path: Path, n_frames: int = 4) -> None:
    """The first scene from the first descent, evenly spaced in time: frames above, the same with labels below."""
    plan = make_plan(config, kind)
    scene_plan, trajectory = plan.scenes[0], plan.trajectories[0]
    scene = cached_scene(config, plan.exr_camera, config.kind(kind).flight, scene_plan.seed)
    ratio = scene.rims.depth_m / scene.craters.diameter_m
    plain, drawn = [], []
    circles = RimCircles.of_scene(scene)
    pattern = FixedPattern.draw(config.sensor, plan.camera, config.seed)
    with Renderer(
        scene, config, plan.exr_camera, sun_direction(scene_plan.sun_azimuth_deg, scene_plan.sun_elevation_deg)
    ) as renderer:
        for index in np.linspace(0, len(trajectory.splits) - 1, n_frames).astype(int):
            pose = trajectory.flight.position_m[index], trajectory.flight.rotation_camera_from_site[index]
            radiance = renderer.render(*pose)
            velocity = pose[1] @ trajectory.flight.velocity_mps[index]
            rng = stream(trajectory.seed, "sensor", index)
            image = develop(radiance, config.sensor, plan.camera, plan.exr_camera, velocity, pattern, rng)
            seen = seen_by(radiance, plan.camera, plan.exr_camera)
            labels = label_frame(
                circles, plan.camera, *pose, seen, config.labels.min_radius_px, config.labels.max_radius_px
            )
            grey = image if config.sensor.bits == 8 else (image >> (config.sensor.bits - 8)).astype(np.uint8)
            plain.append(enlarge(grey, 2))
            drawn.append(draw_labels(grey, labels, ratio[labels.crater_id]))
    write_sheet(path, plain + drawn, n_frames)
