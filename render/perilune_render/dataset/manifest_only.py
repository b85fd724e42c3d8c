"""Write the manifest of a planned dataset, without frames, to render it later: scenes, trajectories and poses."""

import pyarrow as pa

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset import tables
from perilune_render.dataset.begin import new_info
from perilune_render.flight.plan import make_plan
from perilune_render.flight.pose_checks import check_plan, check_trajectories
from perilune_render.outputs.hazard import check_hazard
from perilune_render.provenance.recipe import recipe_of
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import check_ground, grow_scene
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.names import IMAGE_KINDS, Kind, frame_path, scene_file_path
from perilune_shared.dataset.schema import TABLES
from perilune_shared.editing.writer import new_dataset
from perilune_shared.storage.store import Address


def write_manifest_only(config: DatasetConfig, kind: Kind, preset: str, out: Address, progress: Progress) -> None:
    """Write the manifest of the dataset `detect` or `nav`, as planned, into the new folder `out`.

    Every scene is generated once, for the hash of its content; nothing is rendered. Raises UserError on invalid
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
            wanted = {"png": True, "exr": config.render.exr, "lidar": config.flash_lidar is not None}
            kinds = [kind for kind in IMAGE_KINDS if wanted[kind]]
            hazard = {"hazard_path": scene_file_path(scene_plan.scene_id, "hazard")} if config.hazard else None
            frames = []
            for trajectory in trajectories:
                ids = [trajectory.frame_id(index) for index in range(len(trajectory.splits))]
                paths = [{f"{kind}_path": frame_path(frame_id, kind) for kind in kinds} for frame_id in ids]
                frames.append(tables.frame_table(trajectory, plan.rig[trajectory.camera].camera, scene_plan.sun, paths))
            writer.add_scene(
                {
                    "scenes": tables.scene_tables(scene_plan, scene, config, recipe.key, hazard)["scenes"],
                    "trajectories": tables.trajectory_table(trajectories),
                    "frames": pa.concat_tables(frames),
                    **{name: TABLES[name].empty_table() for name in ("craters", "boulders", "labels")},
                }
            )
            progress.advance(task)
