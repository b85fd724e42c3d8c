"""Render a planned dataset, scene by scene and trajectory by trajectory; an interrupted run can be resumed.

A trajectory's part of `frames` is written last, after its images and labels. A trajectory with this part is finished;
one without it is rendered again.
"""

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa

from perilune_render.blender.renderer import Renderer
from perilune_render.config import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.frame import Shot, Studio
from perilune_render.dataset.output import (
    begin_or_go_on,
    check_begun,
    info_of,
    is_begun,
    open_finished,
    sync_frames,
    write_overview,
    writing,
)
from perilune_render.dataset.real_ground import real_ground_share
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan, make_plan
from perilune_render.flight.pose_checks import Poses, check_plan, check_poses
from perilune_render.imaging.darkness import is_dark, warn_of_dark_frames
from perilune_render.imaging.sensor import FixedPattern
from perilune_render.interrupts import interrupts_held
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.provenance.recipe import recipe_of
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import Scene, check_ground
from perilune_shared.content import content_sha256
from perilune_shared.dataset.manifest import Dataset, count_rows, open_dataset
from perilune_shared.dataset.metadata import DatasetInfo, write_info
from perilune_shared.dataset.parts import read_part, write_part
from perilune_shared.dataset.schema import Kind
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import sun_direction
from perilune_shared.progress import Progress
from perilune_shared.storage.checksums import seal

_GROUND = ("craters", "boulders")


def make_dataset(config: DatasetConfig, kind: Kind, preset: str, out: Path, progress: Progress) -> Dataset:
    """Render the dataset `detect` or `nav` into `out`, or resume it.

    Raises UserError if `out` holds something else.
    """
    plan, where = make_plan(config, kind), f"configuration: dataset.{kind}"
    return render_plan(plan, config, info_of(config, plan, recipe_of(config, kind, preset)), out, progress, where)


def render_plan(
    plan: Plan, config: DatasetConfig, info: DatasetInfo, out: Path, progress: Progress, where: object
) -> Dataset:
    """Render a plan into `out`, or resume it; `info` is the dataset.json to begin with.

    Raises UserError if `out` holds something else, if another process is writing it, or if a pose does not fit the
    ground; the last error names `where`, the origin of the plan. The first scene is checked before anything is written,
    every other one before its first frame is rendered.
    """
    check_ground(config, plan.view)
    check_plan(plan, graded_grid(config.terrain, plan.view), where)
    with writing(out):
        return _render(plan, config, info, out, progress, where)


def _render(
    plan: Plan, config: DatasetConfig, info: DatasetInfo, out: Path, progress: Progress, where: object
) -> Dataset:
    kind = info.recipe().kind
    grown: dict[str, Scene] = {}
    if not is_begun(out) and plan.scenes:
        grown[plan.scenes[0].scene_id] = _grow(plan, plan.scenes[0], config, where)
    info = begin_or_go_on(out, info)
    check_begun(out, plan)
    if info.complete:
        return open_finished(out)
    pattern = FixedPattern.draw(config.sensor, plan.camera, config.seed)
    task = progress.add_task(f"{kind} frames", total=sum(len(t.splits) for t in plan.trajectories), unit="frames")
    for scene_plan in plan.scenes:
        trajectories = plan.of_scene(scene_plan.scene_id)
        waiting = [t for t in trajectories if not _frames_part(out, t).exists()]
        progress.advance(task, sum(len(t.splits) for t in trajectories) - sum(len(t.splits) for t in waiting))
        if not waiting:
            continue
        progress.update(task, note=f"{scene_plan.scene_id}: growing")
        scene = grown.pop(scene_plan.scene_id, None) or _grow(plan, scene_plan, config, where)
        _write_scene(out, scene_plan, scene, config, info.recipe().key, trajectories)
        progress.update(task, note=scene_plan.scene_id)
        sun = sun_direction(scene_plan.sun_azimuth_deg, scene_plan.sun_elevation_deg)
        studio = Studio(config, plan.camera, plan.exr_camera, pattern, RimCircles.of_scene(scene), sun)
        with Renderer(scene, config, plan.exr_camera, sun) as renderer:
            dark = [
                frame_id
                for trajectory in waiting
                for frame_id in _render_trajectory(
                    out, studio, trajectory, scene, renderer, lambda: progress.advance(task)
                )
            ]
        n_rendered = sum(len(t.splits) for t in waiting)
        warn_of_dark_frames(scene_plan.scene_id, dark, n_rendered, scene_plan.sun_elevation_deg)
    dataset = Dataset(out, info)
    finished = info.model_copy(update={"counts": count_rows(dataset), "complete": True})
    write_overview(dataset)
    write_info(out, finished)
    seal(out)
    return open_dataset(out)


def _grow(plan: Plan, scene_plan: ScenePlan, config: DatasetConfig, where: object) -> Scene:
    """Generate the ground of a scene, and check that all its poses fit it."""
    with interrupts_held():
        scene = cached_scene(config, plan.view, scene_plan.seed)
    trajectories = plan.of_scene(scene_plan.scene_id)
    if trajectories:
        check_poses(Poses.planned(trajectories), plan.exr_camera, scene, where)
    return scene


def _frames_part(out: Path, trajectory: TrajectoryPlan) -> Path:
    return out / "manifest" / "frames" / f"{trajectory.scene_id}.{trajectory.trajectory_id}.parquet"


def _write_scene(
    out: Path, plan: ScenePlan, scene: Scene, config: DatasetConfig, recipe: str, trajectories: list[TrajectoryPlan]
) -> None:
    parts = {
        **tables.scene_tables(plan, scene, config, recipe),
        "trajectories": tables.trajectory_table(trajectories),
    }
    paths = {name: out / "manifest" / name / f"{plan.scene_id}.parquet" for name in parts}
    there = {name: read_part(paths[name], name) if paths[name].exists() else parts[name] for name in _GROUND}
    # Compared by content hash, since craters computed on another processor differ in the last digits.
    if content_sha256(*there.values()) != content_sha256(*(parts[name] for name in _GROUND)):
        wanted = "the elevation model and catalogue that it was begun with"
        raise UserError(paths["craters"], "craters", "other craters or boulders", wanted)
    for name, rows in parts.items():
        if not paths[name].exists():
            write_part(out, name, plan.scene_id, rows)


def _render_trajectory(
    out: Path,
    studio: Studio,
    trajectory: TrajectoryPlan,
    scene: Scene,
    renderer: Renderer,
    advance: Callable[[], None],
) -> list[str]:
    """Render and write one trajectory; returns the ids of its dark frames."""
    rows: list[dict] = []
    labels, dark = [], []
    for index in range(len(trajectory.splits)):
        shot = Shot.planned(trajectory, index)
        radiance = renderer.render(shot.position_m, shot.rotation_camera_from_site, seed=shot.render_seed)
        row, exposure = studio.write_png(out, shot, radiance)
        if studio.config.render.exr:
            row |= studio.write_exr(out, shot, radiance)
        pose = shot.position_m, shot.rotation_camera_from_site
        share = real_ground_share(scene, studio.exr_camera, *pose, radiance.depth_m)
        found = studio.label(shot, radiance, exposure)
        rows.append({**row, "real_ground_share": share, "n_craters_above_max_radius": found.n_above})
        labels.append(tables.label_table(shot.frame_id, found))
        if is_dark(radiance):
            dark.append(shot.frame_id)
        advance()
    name = f"{trajectory.scene_id}.{trajectory.trajectory_id}"
    # A run interrupted between the two leaves a labels part without its frames part.
    (out / "manifest" / "labels" / f"{name}.parquet").unlink(missing_ok=True)
    write_part(out, "labels", name, pa.concat_tables(labels))
    sync_frames(out, rows)
    write_part(out, "frames", name, tables.frame_table(trajectory, studio.camera, studio.sun, rows))
    return dark
