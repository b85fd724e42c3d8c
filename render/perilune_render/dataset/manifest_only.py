"""Write the manifest of a planned dataset for later rendering: scenes, trajectories and poses, without images."""

import pyarrow as pa

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.begin import new_info
from perilune_render.flight.plan import Plan, ScenePlan, make_plan
from perilune_render.flight.pose_checks import check_plan, check_trajectories
from perilune_render.outputs.hazard import check_hazard
from perilune_render.provenance.recipe import config_of, recipe_of
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import check_ground, grow_scene
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import IMAGE_KINDS, Kind, frame_path, scene_file_path
from perilune_shared.dataset.schema import TABLES
from perilune_shared.editing.writer import new_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address

_EMPTY = {name: TABLES[name].empty_table() for name in ("craters", "boulders", "labels")}
"""Tables that stay empty, since rendering computes them from scenes and poses."""


def write_manifest_only(config: DatasetConfig, kind: Kind, preset: str, out: Address, progress: Progress) -> None:
    """Write the manifest of the planned dataset `detect` or `nav` into the new folder `out`.

    Every scene is generated once to compute its content hash; nothing is rendered. Raises UserError on invalid
    settings, or if `out` is not empty.
    """
    plan, where = make_plan(config, kind), f"configuration: dataset.{kind}"
    check_ground(config, plan.view)
    grid = graded_grid(config.terrain, plan.view)
    check_plan(plan, grid, where)
    if config.hazard is not None:
        check_hazard(config.hazard, grid)
    recipe = recipe_of(config, kind, preset, planned=True)
    info = new_info(config, plan, recipe).model_copy(update={"complete": True, "images": "planned"})
    task = progress.add_task(f"plan {kind}", total=len(plan.scenes), unit="scenes")
    with new_dataset(out, info) as writer:
        for scene_plan in plan.scenes:
            with interrupts_held():
                scene = grow_scene(config, plan.view, scene_plan.seed)
            trajectories = plan.of_scene(scene_plan.scene_id)
            check_trajectories(plan, trajectories, scene, where)
            hazard = {"hazard_path": scene_file_path(scene_plan.scene_id, "hazard")} if config.hazard else None
            writer.add_scene(
                {
                    "scenes": tables.scene_tables(scene_plan, scene, config, recipe.key, hazard)["scenes"],
                    "trajectories": tables.trajectory_table(trajectories),
                    "frames": _frames_of(config, plan, scene_plan),
                    **_EMPTY,
                }
            )
            progress.advance(task)


def write_left_out_frames(manifest: Dataset, out: Address, progress: Progress) -> None:
    """Restore a manifest's missing table `frames`, and write the whole manifest into the new folder `out`.

    Scenes, trajectories and metadata are copied from the manifest. Poses, splits and times are drawn again with its
    recipe; no ground is generated. Raises UserError if the manifest has several recipes or already has its frames, or
    if its trajectories differ from the trajectories that the recipe gives.
    """
    info, where = manifest.info, manifest.store.at("dataset.json")
    if len(info.recipes) != 1:
        raise UserError(where, "recipes", len(info.recipes), "one recipe, from which the frames are drawn again")
    if not frames_left_out(manifest):
        raise UserError(where, "frames", f"{info.counts.frames} frames", "a manifest whose table `frames` was left out")
    recipe = info.recipe()
    config = config_of(recipe, where, None, None)
    plan = make_plan(config, recipe.kind)
    task = progress.add_task(f"plan {recipe.kind}", total=len(plan.scenes), unit="scenes")
    with new_dataset(out, info) as writer:
        for scene_plan in plan.scenes:
            scene_id = scene_plan.scene_id
            rows = {name: manifest.table(name, scene_id=scene_id) for name in ("scenes", "trajectories")}
            drawn = tables.trajectory_table(plan.of_scene(scene_id))
            if rows["scenes"]["seed"].to_pylist() != [scene_plan.seed] or _seeds(rows["trajectories"]) != _seeds(drawn):
                raise UserError(where, scene_id, "seeds of another plan", "the seeds that its recipe gives")
            writer.add_scene({**rows, "frames": _frames_of(config, plan, scene_plan), **_EMPTY})
            progress.advance(task)


def frames_left_out(manifest: Dataset) -> bool:
    """Whether dataset.json counts frames, but the table `frames` has no rows."""
    return bool(manifest.info.counts.frames) and not manifest.table("frames", ["frame_id"]).num_rows


def _frames_of(config: DatasetConfig, plan: Plan, scene: ScenePlan) -> pa.Table:
    """Rows of the table `frames` of one scene, without columns that are known only after rendering."""
    wanted = {"png": True, "exr": config.render.exr, "lidar": config.flash_lidar is not None}
    kinds = [kind for kind in IMAGE_KINDS if wanted[kind]]
    frames = []
    for trajectory in plan.of_scene(scene.scene_id):
        ids = [trajectory.frame_id(index) for index in range(len(trajectory.splits))]
        paths = [{f"{kind}_path": frame_path(frame_id, kind) for kind in kinds} for frame_id in ids]
        frames.append(tables.frame_table(trajectory, plan.rig[trajectory.camera].camera, scene.sun, paths))
    return pa.concat_tables(frames)


def _seeds(trajectories: pa.Table) -> list[tuple[str, int]]:
    rows = trajectories.select(["trajectory_id", "seed"]).to_pylist()
    return sorted((row["trajectory_id"], row["seed"]) for row in rows)
