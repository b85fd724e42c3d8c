"""Run a job: the three steps, with any executor."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from perilune_render.config import DatasetConfig
from perilune_render.dataset.folder import open_finished, writing
from perilune_render.jobs import steps
from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.work_list import N_ATTEMPTS, WorkList
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import Kind
from perilune_shared.progress import Progress


class Executor(Protocol):
    """Renders trajectories of a job, in this process, in others or on other machines."""

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene and check that its poses fit it. Raises UserError."""

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list. Raises the first error that would also end all other trajectories."""


MakeExecutor = Callable[[Job, Path], AbstractContextManager[Executor]]
"""Makes the executor of a job and its folder."""


class RenderingFailed(Exception):
    """Some trajectories failed N_ATTEMPTS times each; all others are rendered."""

    def __init__(self, out: Path, errors: dict[str, str]):
        self.out, self.errors = out, errors
        super().__init__(f"{out}: {len(errors)} trajectories failed {N_ATTEMPTS} times each")


def make_dataset(
    config: DatasetConfig, kind: Kind, preset: str, out: Path, progress: Progress, executor: MakeExecutor
) -> Dataset:
    """Render the dataset `detect` or `nav` into `out`, or resume it. See `render_job` for the errors."""
    return render_job(Job.planned(config, kind, preset), out, progress, executor)


def render_job(job: Job, out: Path, progress: Progress, executor: MakeExecutor) -> Dataset:
    """Render a job into `out`, or resume it.

    Raises UserError if `out` holds something else, if another process is writing it, or if a pose does not fit the
    ground. The first scene is checked before anything is written, each other scene before its first frame is rendered.
    Raises RenderingFailed at the end if trajectories failed repeatedly.
    """
    steps.check(job)
    with writing(out):
        with executor(job, out) as own:
            info = steps.prepare(job, out, own.check_scene)
            if info.complete:
                return open_finished(out)
            _render(job, out, steps.unfinished(job, out), own, progress)
        return steps.finish(job, out, info)


def _render(job: Job, out: Path, places: list[int], executor: Executor, progress: Progress) -> None:
    """Render some trajectories, given by their places. Raises RenderingFailed at the end if some failed."""
    work = WorkList(job.plan, places)
    executor.render(work, Report(job, places, progress))
    if work.failures:
        raise RenderingFailed(out, {job.name(place): error for place, error in sorted(work.failures.items())})
