"""Render a planned dataset: scene by scene, descent by descent, resumable at every descent.

A descent's frames part is written last, after its images and labels: whatever has a frames part is finished, and what
has none is rendered again.
"""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from rich.progress import Progress

import perilune_render
import perilune_shared
from perilune_render import tables
from perilune_render.blender.renderer import BLENDER_VERSION, Renderer
from perilune_render.config import DatasetConfig
from perilune_render.exr import Radiance, write_exr
from perilune_render.labels import Labels, crater_index, label_frame
from perilune_render.picture import draw_labels, enlarge, write_sheet
from perilune_render.plan import Plan, ScenePlan, TrajectoryPlan, make_plan
from perilune_render.sensor import develop
from perilune_render.streams import derived_seed, stream
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.elevation import read_elevation
from perilune_render.terrain.scene import Scene
from perilune_shared import files
from perilune_shared.descent import ROTATION_CAMERA_FROM_BODY
from perilune_shared.errors import UserError
from perilune_shared.frames import Array, sun_direction
from perilune_shared.manifest import (
    CameraInfo,
    Counts,
    Dataset,
    DatasetInfo,
    count_rows,
    open_dataset,
    write_info,
    write_part,
)
from perilune_shared.schema import SCHEMA_VERSION, Kind

LICENCE = "CC-BY-4.0"
_SHEET_FRAMES = 12


def make_dataset(config: DatasetConfig, kind: Kind, preset: str, out: Path, progress: Progress) -> Dataset:
    """Render the dataset `detect` or `nav` into `out`, going on where an earlier call stopped.

    Raises UserError where `out` holds something else.
    """
    if config.terrain.dem is not None:
        # A fault in it must show before anything is written.
        read_elevation(Path(config.terrain.dem))
    plan = make_plan(config, kind)
    info = _open_or_begin(config, kind, preset, out, plan)
    if info.complete:
        return open_dataset(out)
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
        scene = cached_scene(config, plan.camera, config.kind(kind).flight, scene_plan.seed)
        _write_scene(out, scene_plan, scene, config, trajectories)
        progress.update(task, note=scene_plan.scene_id)
        sun = sun_direction(scene_plan.sun_azimuth_deg, scene_plan.sun_elevation_deg)
        with Renderer(scene, config, plan.camera, sun) as renderer:
            for trajectory in waiting:
                _render_trajectory(out, config, plan, scene, trajectory, sun, renderer, lambda: progress.advance(task))
    dataset = Dataset(out, info)
    finished = info.model_copy(update={"counts": count_rows(dataset), "complete": True})
    _write_overview(dataset)
    write_info(out, finished)
    return open_dataset(out)


def _open_or_begin(config: DatasetConfig, kind: Kind, preset: str, out: Path, plan: Plan) -> DatasetInfo:
    camera = CameraInfo(
        width_px=plan.camera.width_px,
        height_px=plan.camera.height_px,
        fx_px=plan.camera.fx_px,
        fy_px=plan.camera.fy_px,
        cx_px=plan.camera.cx_px,
        cy_px=plan.camera.cy_px,
        rotation_camera_from_body=tuple(map(tuple, ROTATION_CAMERA_FROM_BODY.tolist())),  # type: ignore[arg-type]
        position_in_body_m=(0.0, 0.0, 0.0),
    )
    resolved = json.loads(config.model_dump_json())
    info = DatasetInfo(
        name=f"perilune-{preset}-{kind}",
        kind=kind,
        schema_version=SCHEMA_VERSION,
        complete=False,
        split_by=config.kind(kind).split_by,
        preset=preset,
        config=resolved,
        seed=config.seed,
        camera=camera,
        versions={
            "perilune_render": perilune_render.__version__,
            "perilune_shared": perilune_shared.__version__,
            "blender": BLENDER_VERSION,
        },
        counts=Counts(),
        licence=LICENCE,
    )
    if not (out / "dataset.json").exists():
        if out.exists() and any(out.iterdir()):
            raise UserError(
                out,
                "--out",
                "a folder with other content",
                "an empty or new folder, or a dataset to go on with",
            )
        write_info(out, info)
        return info
    existing = open_dataset(out).info
    for name in ("kind", "config", "versions"):
        theirs, ours = getattr(existing, name), getattr(info, name)
        if name == "config":
            theirs, ours = _without_threads(theirs), _without_threads(ours)
        if theirs != ours:
            raise UserError(
                out / "dataset.json",
                name,
                _first_difference(theirs, ours),
                "the settings that this dataset was begun with, or another --out",
            )
    return existing


def _without_threads(config: dict) -> dict:
    return {**config, "render": {k: v for k, v in config.get("render", {}).items() if k != "threads"}}


def _first_difference(theirs: object, ours: object, path: str = "") -> str:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in sorted({*theirs, *ours}):
            if theirs.get(key) != ours.get(key):
                return _first_difference(theirs.get(key), ours.get(key), f"{path}.{key}".lstrip("."))
    return f"{path} {theirs!r} there, {ours!r} asked for".strip()


def _frames_part(out: Path, trajectory: TrajectoryPlan) -> Path:
    return out / "manifest" / "frames" / f"{trajectory.scene_id}.{trajectory.trajectory_id}.parquet"


def _write_scene(
    out: Path, plan: ScenePlan, scene: Scene, config: DatasetConfig, trajectories: list[TrajectoryPlan]
) -> None:
    parts = {
        **tables.scene_tables(plan, scene, config),
        "trajectories": tables.trajectory_table(trajectories),
    }
    for name, rows in parts.items():
        if not (out / "manifest" / name / f"{plan.scene_id}.parquet").exists():
            write_part(out, name, plan.scene_id, rows)


def _render_trajectory(
    out: Path,
    config: DatasetConfig,
    plan: Plan,
    scene: Scene,
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
        rows.append(write_frame(out, config, plan, scene, trajectory, index, radiance))
        found = label_frame(
            scene, plan.camera, *pose, radiance, config.labels.min_radius_px, config.labels.max_radius_px
        )
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
    scene: Scene,
    trajectory: TrajectoryPlan,
    index: int,
    radiance: Radiance,
) -> dict[str, str | int]:
    """Develop and write one frame's PNG, and its EXR where asked for; its columns png_* and exr_* of the manifest."""
    image = develop(radiance.radiance_factor, config.sensor, stream(trajectory.seed, "sensor", index))
    stem = f"frames/{trajectory.frame_id(index)}"
    paths = {"png": f"{stem}.png"}
    files.write_bytes(out / paths["png"], cv2.imencode(".png", image)[1].tobytes())
    if config.render.exr:
        pose = trajectory.flight.position_m[index], trajectory.flight.rotation_camera_from_site[index]
        paths["exr"] = f"{stem}.exr"
        write_exr(out / paths["exr"], radiance, crater_index(scene, plan.camera, *pose))
    row: dict[str, str | int] = {}
    for name, path in paths.items():
        row[f"{name}_path"] = path
        row[f"{name}_bytes"] = (out / path).stat().st_size
        row[f"{name}_sha256"] = files.sha256_of(out / path)
    return row


def _write_overview(dataset: Dataset) -> None:
    """overview.png: frames from the whole dataset, each beside itself with its labels drawn."""
    frames = dataset.table("frames", ["frame_id", "scene_id", "png_path"]).to_pandas()
    chosen = frames.iloc[np.unique(np.linspace(0, len(frames) - 1, _SHEET_FRAMES).astype(int))]
    labels = dataset.table("labels").to_pandas()
    craters = dataset.table("craters", ["scene_id", "crater_id", "depth_m", "diameter_m"]).to_pandas()
    pictures = []
    for frame in chosen.itertuples():
        image = cv2.imread(str(dataset.file(frame.png_path)), cv2.IMREAD_GRAYSCALE)
        own = labels[labels["frame_id"] == frame.frame_id]
        own = own.merge(craters[craters["scene_id"] == frame.scene_id], on="crater_id")
        drawn = draw_labels(image, Labels.from_table(own), (own["depth_m"] / own["diameter_m"]).to_numpy())
        pictures += [enlarge(image, 2), drawn]
    write_sheet(dataset.root / "overview.png", pictures, 6)
