"""Run a job in three steps: prepare the dataset, render each trajectory, finish the dataset.

A trajectory is finished once its commit is written (`dataset/work.py`).

A dataset can be resumed only with the plan with which it was begun. The plan is identified by a hash, since two
manifests with equal settings may differ in scenes, trajectories, frames and splits.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perilune_render.dataset.begin import begin_or_resume, is_begun, is_complete, open_finished, writing
from perilune_render.dataset.finish import finish as finish_dataset
from perilune_render.dataset.from_manifest import Recorded
from perilune_render.dataset.work import committed
from perilune_render.engines.open_engine import check_engine
from perilune_render.flight.plan import Plan, TrajectoryPlan
from perilune_render.flight.pose_checks import check_plan
from perilune_render.jobs import records
from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.work_list import N_ATTEMPTS, WorkList
from perilune_render.outputs.hazard import check_hazard
from perilune_render.terrain.scene import check_ground
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import remove_temporary_files
from perilune_shared.storage.store import Address, Store, open_store

_EXPECTED = "the plan or manifest that the dataset was started with"


class Executor(Protocol):
    """Renders trajectories of a job in this process, in other processes or on other machines."""

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene and check its poses (`check_poses`). Raises UserError if a check fails."""

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list.

        Raises only errors that would stop every trajectory, such as a full disk. Any other error
        is recorded in the work list as a failed attempt.
        """


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts of a job, with about equal numbers of trajectories."""

    number: int
    """Number of the shard, from 1."""
    count: int
    """Number of shards."""

    def indices(self, n_trajectories: int) -> range:
        """Indices of the shard's trajectories in the plan.

        They are consecutive, so that few scenes belong to several shards.
        """
        first, after = ((k * n_trajectories) // self.count for k in (self.number - 1, self.number))
        return range(first, after)


MakeExecutor = Callable[[Job, Store], AbstractContextManager[Executor]]
"""Function that makes the executor for a job and the store of its dataset."""


class RenderingFailed(Exception):
    """Some trajectories failed N_ATTEMPTS times each; all other trajectories are rendered."""

    def __init__(self, out: Store, errors: dict[str, str]):
        self.out, self.errors = out, errors
        super().__init__(f"{out}: {len(errors)} trajectories failed {N_ATTEMPTS} times each")


def render_job(job: Job, address: Address, progress: Progress, executor: MakeExecutor) -> Dataset:
    """Render a job into the dataset at an address, or resume it.

    The poses of the first scene are checked before anything is written, the poses of every other scene before its first
    frame is rendered. Raises UserError if a pose fails `check_poses`, if the address holds something else, or if
    another run is writing there. Raises RenderingFailed at the end if trajectories failed repeatedly.
    """
    out = open_store(address)
    check(job)
    with writing(out):
        with executor(job, out) as renderers:
            info = prepare(job, out, renderers.check_scene)
            if info.complete:
                return open_finished(out)
            records.remove_running(out)
            _render(job, out, unfinished(job, out), renderers, progress)
        if out.folder is not None:
            remove_temporary_files(out.folder)  # left by workers that were killed
        return finish(job, out, info)


def render_shard(job: Job, address: Address, shard: Shard, progress: Progress, executor: MakeExecutor) -> int:
    """Render the unfinished trajectories of one shard of a job into the dataset at an address; return their number.

    The dataset is not locked, since processes on many machines may render its other shards at the same time. Raises the
    errors of `render_job`.
    """
    out = open_store(address)
    check(job)
    with executor(job, out) as renderers:
        info = prepare(job, out, renderers.check_scene)
        chosen = set(shard.indices(len(job.plan.trajectories)))
        indices = [index for index in unfinished(job, out) if index in chosen and not info.complete]
        _render(job, out, indices, renderers, progress)
    return len(indices)


def finish_job(job: Job, address: Address) -> Dataset:
    """Finish a dataset whose shards are all rendered.

    Raises UserError if a trajectory is not rendered yet.
    """
    out = open_store(address)
    if not is_begun(out):
        raise UserError(out, "--finish", "no dataset", "the address of the rendered shards")
    with writing(out):
        info = prepare(job, out, lambda scene_id: None)
        return open_finished(out) if info.complete else finish(job, out, info)


def _render(job: Job, out: Store, indices: list[int], executor: Executor, progress: Progress) -> None:
    """Render trajectories by their indices. Raises RenderingFailed at the end if trajectories failed repeatedly."""
    work = WorkList(job.plan, indices)
    records.remove_failures(out, map(job.name, indices))
    executor.render(work, Report(job, indices, progress))
    if work.failures:
        errors = {job.name(index): error for index, error in sorted(work.failures.items())}
        for name, error in errors.items():
            records.write_failure(out, name, error)
        raise RenderingFailed(out, errors)


def check(job: Job) -> None:
    """Check engine, settings, poses and files of a job before any terrain is generated. Raises UserError."""
    check_engine(job.config.render)
    grid = check_ground(job.config, job.plan.view)
    check_plan(job.plan, grid, job.where)
    if job.config.hazard is not None:
        check_hazard(job.config.hazard, grid)


def prepare(job: Job, out: Store, check_scene: Callable[[str], object]) -> DatasetInfo:
    """Begin the dataset at `out`, or check that an existing dataset belongs to the job; return its dataset.json.

    Before a dataset is begun, `check_scene` is called for its first scene. Raises UserError if a pose fails
    `check_poses`, or if `out` holds other files, or a dataset with different settings, code or plan.
    """
    if not is_begun(out) and job.plan.scenes:
        check_scene(job.plan.scenes[0].scene_id)
    info = begin_or_resume(out, job.info)
    if info.complete:
        _check_finished(out, job.plan)
    else:
        _begin_plan(out, job)
    return info


def unfinished(job: Job, out: Store) -> list[int]:
    """Indices of the trajectories that are still to be rendered, in the order of the plan."""
    if is_complete(out):
        return []
    finished = committed(out)
    return [
        index
        for index, trajectory in enumerate(job.plan.trajectories)
        if f"{trajectory.scene_id}.{trajectory.trajectory_id}" not in finished
    ]


def finish(job: Job, out: Store, info: DatasetInfo) -> Dataset:
    """Merge the trajectories into a complete dataset. Raises UserError if a trajectory is not rendered yet."""
    left = unfinished(job, out)
    if left:
        actual = f"{len(left)} of {len(job.plan.trajectories)} trajectories not rendered, first {job.name(left[0])}"
        raise UserError(out, "trajectories", actual, "all rendered; run their shards again")
    scenes = (
        (scene.scene_id, [trajectory.trajectory_id for trajectory in job.plan.of_scene(scene.scene_id)])
        for scene in job.plan.scenes
        if job.plan.ranges.get(scene.scene_id)
    )
    return finish_dataset(out, info, scenes)


def _begin_plan(store: Store, job: Job) -> None:
    """Record the size and hash of a job's plan in a new dataset, or compare them with an existing record.

    Raises UserError if the dataset was begun with another plan.
    """
    indices = range(len(job.plan.trajectories))
    sizes = {"trajectories": len(indices), "frames": sum(map(job.n_frames, indices))}
    plan = {**sizes, "plan": _hash(_ordered(job.plan), positions=_is_recorded(job.plan))}
    if records.read_plan(store) is None:
        records.write_plan(store, plan)
    elif records.read_plan(store) != plan:
        raise UserError(store.at(f"{records.FOLDER}/plan.json"), "plan", "the plan of another dataset", _EXPECTED)


def _check_finished(store: Store, plan: Plan) -> None:
    """Raise UserError if a finished dataset has another plan."""
    finished = open_dataset(store)
    recorded = Recorded.of(finished, finished.scene_ids())
    positions = _is_recorded(plan)
    if _hash(recorded, positions=positions) != _hash(_ordered(plan), positions=positions):
        raise UserError(store, "trajectories", "trajectories of another plan", _EXPECTED)


def _is_recorded(plan: Plan) -> bool:
    return len(plan.trajectories) > 0 and not plan.trajectories[0].is_drawn


def _ordered(plan: Plan) -> Iterator[TrajectoryPlan]:
    """The trajectories of a plan, ordered by scene and id as in a manifest."""
    for scene_id in sorted(plan.ranges):
        yield from sorted(plan.of_scene(scene_id), key=lambda trajectory: trajectory.trajectory_id)


def _hash(trajectories: Iterable[TrajectoryPlan], *, positions: bool) -> str:
    """SHA-256 of trajectories, hexadecimal; with `positions`, the hash includes the position of each frame.

    Positions of drawn flights need no hash: they follow from seed, settings and code, which the recipe contains.
    """
    digest = hashlib.sha256()
    for each in trajectories:
        named = [each.scene_id, each.trajectory_id, each.seed, ",".join(each.splits)]
        digest.update(json.dumps(named).encode())
        digest.update(np.asarray(each.frame_index, np.int64).tobytes())
        if positions:
            digest.update(np.ascontiguousarray(each.flight.position_m, np.float64).tobytes())
    return digest.hexdigest()
