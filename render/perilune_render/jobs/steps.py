"""The first and the last of the three steps of a job: prepare, render each trajectory, finish.

`SceneRenderer` is the second step. A trajectory is finished once its commit is written (`dataset/work.py`).
"""

from collections.abc import Callable

from perilune_render.dataset.begin import begin_or_resume, is_begun, is_complete
from perilune_render.dataset.finish import finish as finish_dataset
from perilune_render.dataset.work import committed
from perilune_render.flight.pose_checks import check_plan
from perilune_render.jobs.identity import begin_plan, check_finished
from perilune_render.jobs.job import Job
from perilune_render.outputs.hazard import check_hazard
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import check_ground
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store


def check(job: Job) -> None:
    """Make the checks of a job that need no terrain heights and write nothing. Raises UserError."""
    check_ground(job.config, job.plan.view)
    grid = graded_grid(job.config.terrain, job.plan.view)
    check_plan(job.plan, grid, job.where)
    if job.config.hazard is not None:
        check_hazard(job.config.hazard, grid)


def prepare(job: Job, out: Store, check_scene: Callable[[str], object]) -> DatasetInfo:
    """Begin the dataset at `out`, or check that it belongs to the job; returns its dataset.json.

    Before a dataset is begun, `check_scene` generates its first scene and checks all poses over it. Raises UserError if
    a pose does not fit the ground, or if `out` holds something else or a dataset of other settings, code or plan.
    """
    if not is_begun(out) and job.plan.scenes:
        check_scene(job.plan.scenes[0].scene_id)
    info = begin_or_resume(out, job.info)
    if info.complete:
        check_finished(out, job.plan)
    else:
        begin_plan(out, job)
    return info


def unfinished(job: Job, out: Store) -> list[int]:
    """Places of the trajectories that are still to be rendered, in the order of the plan."""
    if is_complete(out):
        return []
    finished = committed(out)
    return [
        place
        for place, trajectory in enumerate(job.plan.trajectories)
        if f"{trajectory.scene_id}.{trajectory.trajectory_id}" not in finished
    ]


def finish(job: Job, out: Store, info: DatasetInfo) -> Dataset:
    """Merge the trajectories into a complete dataset. Raises UserError if some are still to be rendered."""
    left = unfinished(job, out)
    if left:
        found = f"{len(left)} of {len(job.plan.trajectories)} trajectories not rendered, first {job.name(left[0])}"
        raise UserError(out, "trajectories", found, "all rendered: run the shards that hold them again")
    scenes = (
        (scene.scene_id, [trajectory.trajectory_id for trajectory in job.plan.of_scene(scene.scene_id)])
        for scene in job.plan.scenes
        if job.plan.places.get(scene.scene_id)
    )
    return finish_dataset(out, info, scenes)
