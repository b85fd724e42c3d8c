"""Report the progress of a job: a progress bar, failed attempts and warnings of dark frames."""

from collections import Counter, defaultdict
from collections.abc import Sequence

from perilune_render.imaging.darkness import warn_of_dark_frames
from perilune_render.jobs.job import Job
from perilune_shared.console.progress import Progress, say
from perilune_shared.errors import one_line, shortened


class Report:
    """Reports on the rendering of trajectories, which are identified by their indices in the plan."""

    def __init__(self, job: Job, indices: Sequence[int], progress: Progress):
        self._job, self._progress = job, progress
        todo = set(indices)
        finished = sum(job.n_frames(index) for index in range(len(job.plan.trajectories)) if index not in todo)
        n_frames = finished + sum(map(job.n_frames, todo))
        self._task = progress.add_task(f"{job.info.kind} frames", total=n_frames, unit="frames", note="")
        progress.advance(self._task, finished)
        self._left = Counter(job.plan.trajectories[index].scene_id for index in todo)
        self._rendered: Counter[str] = Counter()
        self._dark: defaultdict[str, list[str]] = defaultdict(list)
        self._frames: Counter[int] = Counter()

    def started(self, index: int) -> None:
        """Record that a process begins a trajectory."""

    def frame(self, index: int) -> None:
        """Count a rendered frame of a trajectory."""
        self._frames[index] += 1
        self._progress.advance(self._task)

    def note(self, text: str) -> None:
        """Show a text about the current step beside the progress bar."""
        self._progress.update(self._task, note=text)

    def done(self, index: int, dark: Sequence[str]) -> None:
        """Count a finished trajectory with the ids of its dark frames.

        After the last trajectory of a scene, warn of the scene's dark frames.
        """
        scene_id = self._job.plan.trajectories[index].scene_id
        self._dark[scene_id] += dark
        self._rendered[scene_id] += self._job.n_frames(index)
        self._close(scene_id)

    def failed(self, index: int, error: str, attempts_left: int) -> None:
        """Report a failed attempt, and take its frames off the progress bar."""
        self._progress.advance(self._task, -self._frames.pop(index, 0))
        again = f"; trying again ({attempts_left} left)" if attempts_left else ""
        say(f"warning: {self._job.name(index)}: {shortened(one_line(error), 500)}{again}")
        if not attempts_left:
            self._close(self._job.plan.trajectories[index].scene_id)

    def _close(self, scene_id: str) -> None:
        self._left[scene_id] -= 1
        if not self._left[scene_id]:
            sun_deg = self._job.scene(scene_id).sun_elevation_deg
            warn_of_dark_frames(scene_id, sorted(self._dark[scene_id]), self._rendered[scene_id], sun_deg)
