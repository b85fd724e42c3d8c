"""Run a job: the three steps, with any executor."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from perilune_render.dataset.begin import is_begun, open_finished, writing
from perilune_render.jobs import records, steps
from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.work_list import N_ATTEMPTS, WorkList
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import remove_temporary_files
from perilune_shared.storage.store import Address, Store, open_store


class Executor(Protocol):
    """Renders trajectories of a job, in this process, in others or on other machines."""

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene and check that its poses fit it. Raises UserError."""

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list. Raises the first error that would also end all other trajectories."""


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several equal shares of a job's trajectories."""

    number: int
    """Number of the shard, from 1."""
    count: int
    """Number of shards."""

    def places(self, n_trajectories: int) -> range:
        """Places of its trajectories. Consecutive, so that few scenes are in several shards."""
        first, after = ((k * n_trajectories) // self.count for k in (self.number - 1, self.number))
        return range(first, after)


MakeExecutor = Callable[[Job, Store], AbstractContextManager[Executor]]
"""Makes the executor of a job and the store of its dataset."""


class RenderingFailed(Exception):
    """Some trajectories failed N_ATTEMPTS times each; all others are rendered."""

    def __init__(self, out: Store, errors: dict[str, str]):
        self.out, self.errors = out, errors
        super().__init__(f"{out}: {len(errors)} trajectories failed {N_ATTEMPTS} times each")


def render_job(job: Job, address: Address, progress: Progress, executor: MakeExecutor) -> Dataset:
    """Render a job into the dataset at an address, or resume it.

    Raises UserError if the address holds something else, if another run is writing it, or if a pose does not fit the
    ground. The first scene is checked before anything is written, each other scene before its first frame is rendered.
    Raises RenderingFailed at the end if trajectories failed repeatedly.
    """
    out = open_store(address)
    steps.check(job)
    with writing(out):
        with executor(job, out) as own:
            info = steps.prepare(job, out, own.check_scene)
            if info.complete:
                return open_finished(out)
            records.remove_running(out)
            _render(job, out, steps.unfinished(job, out), own, progress)
        if out.folder is not None:
            remove_temporary_files(out.folder)  # of workers that were killed
        return steps.finish(job, out, info)


def render_shard(job: Job, address: Address, shard: Shard, progress: Progress, executor: MakeExecutor) -> int:
    """Render the unfinished trajectories of one shard of a job into the dataset at an address; returns their number.

    Processes on many machines may render different shards into one dataset at the same time, so it is not locked.
    Raises the errors of `render_job`.
    """
    out = open_store(address)
    steps.check(job)
    with executor(job, out) as own:
        info = steps.prepare(job, out, own.check_scene)
        chosen = set(shard.places(len(job.plan.trajectories)))
        places = [place for place in steps.unfinished(job, out) if place in chosen and not info.complete]
        _render(job, out, places, own, progress)
    return len(places)


def finish_job(job: Job, address: Address) -> Dataset:
    """Finish a dataset whose shards are all rendered. Raises UserError if trajectories are still to be rendered."""
    out = open_store(address)
    if not is_begun(out):
        raise UserError(out, "--finish", "no dataset", "the address of the rendered shards")
    with writing(out):
        info = steps.prepare(job, out, lambda scene_id: None)
        return open_finished(out) if info.complete else steps.finish(job, out, info)


def _render(job: Job, out: Store, places: list[int], executor: Executor, progress: Progress) -> None:
    """Render some trajectories, given by their places. Raises RenderingFailed at the end if some failed."""
    work = WorkList(job.plan, places)
    records.remove_failures(out, map(job.name, places))
    executor.render(work, Report(job, places, progress))
    if work.failures:
        errors = {job.name(place): error for place, error in sorted(work.failures.items())}
        for name, error in errors.items():
            records.write_failure(out, name, error)
        raise RenderingFailed(out, errors)
