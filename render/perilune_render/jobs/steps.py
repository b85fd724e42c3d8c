"""The first and the last of the three steps of a job: prepare, render each trajectory, finish.

`SceneRenderer` is the second step. A trajectory is finished once its part of `frames` is written, which comes last.
"""

from collections.abc import Callable
from pathlib import Path

from perilune_render.dataset.folder import begin_or_resume, check_begun, is_begun
from perilune_render.dataset.folder import finish as finish_folder
from perilune_render.dataset.trajectory_parts import finished_names
from perilune_render.flight.pose_checks import check_plan
from perilune_render.jobs import records
from perilune_render.jobs.job import Job
from perilune_render.terrain.grid import graded_grid
from perilune_render.terrain.scene import check_ground
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store


def check(job: Job) -> None:
    """Make the checks of a job that need no terrain heights and write nothing. Raises UserError."""
    check_ground(job.config, job.plan.view)
    check_plan(job.plan, graded_grid(job.config.terrain, job.plan.view), job.where)


def prepare(job: Job, out: Path, check_scene: Callable[[str], object]) -> DatasetInfo:
    """Begin the dataset in `out`, or check that it is the job's; returns its dataset.json.

    Before a dataset is begun, `check_scene` generates its first scene and checks all poses over it. Raises UserError if
    a pose does not fit the ground, or if `out` holds something else or a dataset of other settings, code or plan.
    """
    if not is_begun(out) and job.plan.scenes:
        check_scene(job.plan.scenes[0].scene_id)
    info = begin_or_resume(out, job.info)
    check_begun(out, job.plan)
    if not info.complete:
        records.write_plan(open_store(out), job)
    return info


def unfinished(job: Job, out: Path) -> list[int]:
    """Places of the trajectories that are still to be rendered, in the order of the plan."""
    finished = finished_names(out)
    return [
        place
        for place, trajectory in enumerate(job.plan.trajectories)
        if (trajectory.scene_id, trajectory.trajectory_id) not in finished
    ]


def finish(job: Job, out: Path, info: DatasetInfo) -> Dataset:
    """Write overview, counts and index of a dataset. Raises UserError if trajectories are still to be rendered."""
    left = unfinished(job, out)
    if left:
        found = f"{len(left)} of {len(job.plan.trajectories)} trajectories not rendered, first {job.name(left[0])}"
        raise UserError(out, "trajectories", found, "all rendered: run the shards that hold them again")
    # First, since nothing would remove them from a dataset that was complete when the process was killed.
    records.remove_all(open_store(out))
    return finish_folder(out, info)
