"""Render a planned dataset: scene by scene, descent by descent, resumable at every descent.

A descent's frames part is written last, after its images and labels: whatever has a frames part is finished, and what
has none is rendered again.
"""

from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
from rich.progress import Progress

from perilune_render import tables
from perilune_render.blender.renderer import Renderer
from perilune_render.config import DatasetConfig
from perilune_render.exr import Radiance, write_exr
from perilune_render.labels import RimCircles, Shown, crater_index, label_frame, with_contrast
from perilune_render.output import begin_or_go_on, file_columns, write_overview, write_png
from perilune_render.plan import Plan, ScenePlan, TrajectoryPlan, make_plan
from perilune_render.recipe import recipe_of
from perilune_render.resample import seen_by
from perilune_render.sensor import Exposure, FixedPattern, expected, expose, read_out
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.catalogue import read_catalogue
from perilune_render.terrain.elevation import read_elevation
from perilune_render.terrain.grid import Grid, graded_grid
from perilune_render.terrain.scene import Scene, resolved_m
from perilune_shared.checksums import seal
from perilune_shared.errors import UserError
from perilune_shared.frames import Array, sun_direction
from perilune_shared.info import CameraInfo, Counts, DatasetInfo, recipes_of, write_info
from perilune_shared.manifest import Dataset, count_rows, open_dataset
from perilune_shared.parts import read_part, write_part
from perilune_shared.schema import SCHEMA_VERSION, Kind

LICENCE = "CC-BY-4.0"


def make_dataset(config: DatasetConfig, kind: Kind, preset: str, out: Path, progress: Progress) -> Dataset:
    """Render the dataset `detect` or `nav` into `out`, going on where an earlier call stopped.

    Raises UserError where `out` holds something else.
    """
    plan = make_plan(config, kind)
    _check_ground(config, graded_grid(config, plan.exr_camera, config.kind(kind).flight))
    info = _open_or_begin(config, kind, preset, out, plan)
    if info.complete:
        return open_dataset(out)
    pattern = FixedPattern.draw(config.sensor, plan.camera, config.seed)
    task = progress.add_task(
        f"{kind} frames", total=sum(len(t.splits) for t in plan.trajectories), unit="frames", note=""
    )
    for scene_plan in plan.scenes:
        trajectories = plan.of_scene(scene_plan.scene_id)
        waiting = [t for t in trajectories if not _frames_part(out, t).exists()]
        progress.advance(task, sum(len(t.splits) for t in trajectories if t not in waiting))
        if not waiting:
            continue
        progress.update(task, note=f"{scene_plan.scene_id}: growing")
        scene = cached_scene(config, plan.exr_camera, config.kind(kind).flight, scene_plan.seed)
        _write_scene(out, scene_plan, scene, config, info.recipe().key, trajectories)
        progress.update(task, note=scene_plan.scene_id)
        sun = sun_direction(scene_plan.sun_azimuth_deg, scene_plan.sun_elevation_deg)
        circles = RimCircles.of_scene(scene)
        with Renderer(scene, config, plan.exr_camera, sun) as renderer:
            for trajectory in waiting:
                _render_trajectory(
                    out, config, plan, circles, pattern, trajectory, sun, renderer, lambda: progress.advance(task)
                )
    dataset = Dataset(out, info)
    finished = info.model_copy(update={"counts": count_rows(dataset), "complete": True})
    write_overview(dataset)
    write_info(out, finished)
    seal(out)
    return open_dataset(out)


def _check_ground(config: DatasetConfig, grid: Grid) -> None:
    """Faults of the files that the ground is made from must show before anything is written."""
    if config.terrain.dem is not None:
        model = read_elevation(Path(config.terrain.dem))
        if config.terrain.catalogue is not None:
            read_catalogue(Path(config.terrain.catalogue), model, grid, config.terrain.craters, resolved_m(model))


def _open_or_begin(config: DatasetConfig, kind: Kind, preset: str, out: Path, plan: Plan) -> DatasetInfo:
    info = DatasetInfo(
        name=f"perilune-{preset}-{kind}",
        kind=kind,
        schema_version=SCHEMA_VERSION,
        complete=False,
        images="files",
        split_by=config.kind(kind).split_by,
        camera=CameraInfo.of(plan.camera),
        exr_camera=CameraInfo.of(plan.exr_camera) if config.render.exr else None,
        recipes=recipes_of(recipe_of(config, kind, preset)),
        counts=Counts(),
        licence=LICENCE,
    )
    return begin_or_go_on(out, info)


def _frames_part(out: Path, trajectory: TrajectoryPlan) -> Path:
    return out / "manifest" / "frames" / f"{trajectory.scene_id}.{trajectory.trajectory_id}.parquet"


def _write_scene(
    out: Path, plan: ScenePlan, scene: Scene, config: DatasetConfig, recipe: str, trajectories: list[TrajectoryPlan]
) -> None:
    parts = {
        **tables.scene_tables(plan, scene, config, recipe),
        "trajectories": tables.trajectory_table(trajectories),
    }
    for name, rows in parts.items():
        part = out / "manifest" / name / f"{plan.scene_id}.parquet"
        if not part.exists():
            write_part(out, name, plan.scene_id, rows)
        elif name == "craters" and not read_part(part, name).equals(rows):
            raise UserError(part, name, "other craters", "the elevation model and catalogue that it was begun with")


def _render_trajectory(
    out: Path,
    config: DatasetConfig,
    plan: Plan,
    circles: RimCircles,
    pattern: FixedPattern,
    trajectory: TrajectoryPlan,
    sun: Array,
    renderer: Renderer,
    advance: Callable[[], None],
) -> None:
    rows, labels = [], []
    flight = trajectory.flight
    for index in range(len(trajectory.splits)):
        pose = flight.position_m[index], flight.rotation_camera_from_site[index]
        radiance = renderer.render(*pose, seed=derived_seed(trajectory.seed, "frame", index))
        velocity = pose[1] @ flight.velocity_mps[index]
        exposure = expose(radiance, config.sensor, plan.camera, plan.exr_camera, velocity)
        rows.append(write_frame(out, config, plan, circles, pattern, trajectory, index, radiance, exposure))
        seen = seen_by(radiance, plan.camera, plan.exr_camera)
        limits = config.labels.min_radius_px, config.labels.max_radius_px
        shown = Shown(*expected(exposure, config.sensor), sun)
        found = label_frame(circles, plan.camera, *pose, seen, *limits)
        found = with_contrast(found, circles, plan.camera, *pose, shown)
        labels.append(tables.label_table(trajectory.frame_id(index), found))
        advance()
    name = f"{trajectory.scene_id}.{trajectory.trajectory_id}"
    # A labels part without its frames part is left from a stop between the two.
    (out / "manifest" / "labels" / f"{name}.parquet").unlink(missing_ok=True)
    write_part(out, "labels", name, pa.concat_tables(labels))
    write_part(out, "frames", name, tables.frame_table(trajectory, plan.camera, sun, rows))


def write_frame(
    out: Path,
    config: DatasetConfig,
    plan: Plan,
    circles: RimCircles,
    pattern: FixedPattern,
    trajectory: TrajectoryPlan,
    index: int,
    radiance: Radiance,
    exposure: Exposure,
) -> dict[str, str | int]:
    """Write one frame's PNG from its exposure, and its EXR where asked for; its columns png_* and exr_*."""
    flight, frame_id = trajectory.flight, trajectory.frame_id(index)
    image = read_out(exposure, config.sensor, pattern, stream(trajectory.seed, "sensor", index))
    row = write_png(out, frame_id, image, config.sensor.bits)
    if config.render.exr:
        path = f"frames/{frame_id}.exr"
        pose = flight.position_m[index], flight.rotation_camera_from_site[index]
        write_exr(out / path, radiance, crater_index(circles, plan.exr_camera, *pose, radiance.depth_m))
        row |= file_columns(out, "exr", path)
    return row
