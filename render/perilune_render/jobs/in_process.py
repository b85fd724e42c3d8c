"""Render a job in this process."""

from functools import partial
from types import TracebackType

from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.scene_renderer import SceneRenderer
from perilune_render.jobs.work_list import WorkList
from perilune_shared.console.progress import say
from perilune_shared.errors import ends_run
from perilune_shared.storage.store import Store


class InProcess:
    """Executor that renders in this process, one trajectory after another."""

    def __init__(self, job: Job, out: Store):
        self._renderer = SceneRenderer(job, out)

    def __enter__(self) -> "InProcess":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.__exit__(kind, error, trace)

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene and check its poses (`check_poses`). Raises UserError if a check fails."""
        for line in self._renderer.check(scene_id):
            say(line)

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list.

        Raises only errors that would stop every trajectory, such as a full disk. Any other error
        is recorded in the work list as a failed attempt.
        """
        while (index := work.take(self._renderer.scene_id)) is not None:
            report.started(index)
            try:
                dark = self._renderer.render(index, partial(report.frame, index), report.note)
            except Exception as error:
                if ends_run(error):
                    raise
                text = f"{type(error).__name__}: {error}"
                report.failed(index, text, work.failed(index, text))
            else:
                work.done(index)
                report.done(index, dark)
