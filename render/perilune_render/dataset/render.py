"""Render a planned dataset, scene by scene and trajectory by trajectory; an interrupted run can be resumed.

A trajectory's part of `frames` is written last, after its images and labels. A trajectory with this part is finished;
one without it is rendered again.
"""

from pathlib import Path

from perilune_render.blender.renderer import Renderer
from perilune_render.config import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.folder import (
    begin_or_resume,
    check_begun,
    finish,
    is_begun,
    new_info,
    open_finished,
    writing,
)
from perilune_render.dataset.trajectory import render_trajectory
from perilune_render.dataset.trajectory_parts import is_finished
from perilune_render.flight.plan import Plan, ScenePlan, TrajectoryPlan, make_plan
from perilune_render.flight.pose_checks import Poses, check_plan, check_poses
from perilune_render.frame_source import FrameSource
from perilune_render.imaging.darkness import warn_of_dark_frames
from perilune_render.labels.frame_labels import RimCircles
from perilune_render.provenance.recipe import recipe_of
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import Scene, check_ground
from perilune_shared.content import content_sha256
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import Kind
from perilune_shared.dataset.parts import read_part, write_part
from perilune_shared.errors import UserError
from perilune_shared.interrupts import interrupts_held
from perilune_shared.progress import Progress

_GROUND = ("craters", "boulders")


def make_dataset(config: DatasetConfig, kind: Kind, preset: str, out: Path, progress: Progress) -> Dataset:
    """Render the dataset `detect` or `nav` into `out`, or resume it.

    Raises UserError if `out` holds something else.
    """
    plan, where = make_plan(config, kind), f"configuration: dataset.{kind}"
    return render_plan(plan, config, new_info(config, plan, recipe_of(config, kind, preset)), out, progress, where)


def render_plan(
    plan: Plan, config: DatasetConfig, info: DatasetInfo, out: Path, progress: Progress, where: object
) -> Dataset:
    """Render a plan into `out`, or resume it; `info` is the initial dataset.json.

    Raises UserError if `out` holds something else, if another process is writing it, or if a pose does not fit the
    ground; the error about a pose names `where`, the origin of the plan. The first scene is checked before anything is
    written, each other scene before its first frame is rendered.
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
    info = begin_or_resume(out, info)
    check_begun(out, plan)
    if info.complete:
        return open_finished(out)
    task = progress.add_task(
        f"{kind} frames", total=sum(len(t.splits) for t in plan.trajectories), unit="frames", note=""
    )
    for scene_plan in plan.scenes:
        trajectories = plan.of_scene(scene_plan.scene_id)
        unfinished = [t for t in trajectories if not is_finished(out, t.scene_id, t.trajectory_id)]
        progress.advance(task, sum(len(t.splits) for t in trajectories) - sum(len(t.splits) for t in unfinished))
        if not unfinished:
            continue
        progress.update(task, note=f"{scene_plan.scene_id}: generating ground")
        scene = grown.pop(scene_plan.scene_id, None) or _grow(plan, scene_plan, config, where)
        _write_scene(out, scene_plan, scene, config, info.recipe().key, trajectories)
        progress.update(task, note=scene_plan.scene_id)
        with Renderer(scene, config, plan.exr_camera, scene_plan.sun) as engine:
            source = FrameSource.of(engine, config, plan.camera, RimCircles.of_scene(scene))
            dark = [
                frame_id
                for trajectory in unfinished
                for frame_id in render_trajectory(
                    out, source, trajectory, scene, config, lambda: progress.advance(task)
                )
            ]
        n_rendered = sum(len(t.splits) for t in unfinished)
        warn_of_dark_frames(scene_plan.scene_id, dark, n_rendered, scene_plan.sun_elevation_deg)
    return finish(out, info)


def _grow(plan: Plan, scene_plan: ScenePlan, config: DatasetConfig, where: object) -> Scene:
    """Generate the ground of a scene, and check that all its poses fit it."""
    with interrupts_held():
        scene = cached_scene(config, plan.view, scene_plan.seed)
    trajectories = plan.of_scene(scene_plan.scene_id)
    if trajectories:
        check_poses(Poses.planned(trajectories), plan.exr_camera, scene, where)
    return scene


def _write_scene(
    out: Path, plan: ScenePlan, scene: Scene, config: DatasetConfig, recipe: str, trajectories: list[TrajectoryPlan]
) -> None:
    parts = {
        **tables.scene_tables(plan, scene, config, recipe),
        "trajectories": tables.trajectory_table(trajectories),
    }
    paths = {name: out / "manifest" / name / f"{plan.scene_id}.parquet" for name in parts}
    existing = {name: read_part(paths[name], name) if paths[name].exists() else parts[name] for name in _GROUND}
    # Compared by content hash, since craters computed on another processor may differ in the last digits.
    if content_sha256(*existing.values()) != content_sha256(*(parts[name] for name in _GROUND)):
        expected = "the elevation model and catalogue that the dataset was started with"
        raise UserError(paths["craters"], "craters", "other craters or boulders", expected)
    for name, rows in parts.items():
        if not paths[name].exists():
            write_part(out, name, plan.scene_id, rows)
