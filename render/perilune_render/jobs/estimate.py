"""Estimate the run time and size of a job from a few frames rendered into a temporary folder."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from perilune_render.flight.plan import TrajectoryPlan
from perilune_render.flight.trajectories import Flight
from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.run import MakeExecutor, RenderingFailed, check, finish, prepare, unfinished
from perilune_render.jobs.work_list import WorkList
from perilune_shared.console.progress import Progress
from perilune_shared.dataset.index import INDEX
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.storage.store import Address, open_store

_N_FRAMES = 10
"""Number of frames rendered for each trajectory of the sample."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """The remaining work, with its estimated time and size."""

    n_frames: int
    """Number of frames that are still to be rendered."""
    seconds: float
    """Time to render these frames, including start and finish, seconds."""
    n_bytes: float
    """Size of the files and rows of these frames, bytes."""


class _Times(Report):
    """Records when each trajectory begins and ends and when its frames are rendered, by `time.perf_counter`."""

    def __init__(self, job: Job, indices: list[int], progress: Progress):
        super().__init__(job, indices, progress)
        self.begin: dict[int, float] = {}
        self.frames: dict[int, list[float]] = {}
        self.end: dict[int, float] = {}

    def started(self, index: int) -> None:
        self.begin[index], self.frames[index] = time.perf_counter(), []

    def frame(self, index: int) -> None:
        super().frame(index)
        self.frames[index].append(time.perf_counter())

    def done(self, index: int, dark: Sequence[str]) -> None:
        super().done(index, dark)
        self.end[index] = time.perf_counter()


def estimate(job: Job, address: Address, progress: Progress, executor: MakeExecutor, n_workers: int) -> Estimate:
    """Estimate the remaining work of a job at an address, with an executor of `n_workers` processes.

    Each process renders up to ten frames of one trajectory; the trajectories come from different scenes if there are
    enough scenes. Nothing is written to the address. Raises UserError like `check` and if a pose fails
    `check_poses`, and RenderingFailed if frames cannot be rendered.
    """
    out = open_store(address)
    check(job)
    left = unfinished(job, out)
    if not left:
        return Estimate(0, 0.0, 0.0)
    sample = _sample(job, left, max(n_workers, 1))
    indices = list(range(len(sample.plan.trajectories)))
    with tempfile.TemporaryDirectory(prefix="perilune-") as folder:
        begin, scratch = time.perf_counter(), open_store(folder)
        with executor(sample, scratch) as renderers:
            info = prepare(sample, scratch, lambda scene_id: None)
            work, times = WorkList(sample.plan, indices), _Times(sample, indices, progress)
            renderers.render(work, times)
        if work.failures:
            raise RenderingFailed(out, {sample.name(index): error for index, error in work.failures.items()})
        finish_begin = time.perf_counter()
        dataset = finish(sample, scratch, info)
        finish_s = time.perf_counter() - finish_begin
        bytes_of = _Bytes.of(dataset)
    frame_s = fmean((times.frames[p][-1] - times.frames[p][0]) / max(len(times.frames[p]) - 1, 1) for p in indices)
    scene_s = max(fmean(times.frames[p][0] - times.begin[p] for p in indices) - frame_s, 0.0)
    parts_s = fmean(times.end[p] - times.frames[p][-1] for p in indices)
    n_frames, n_scenes = sum(map(job.n_frames, left)), len({job.plan.trajectories[p].scene_id for p in left})
    n_parallel = min(max(n_workers, 1), len(left))
    work_s = n_frames * frame_s + len(left) * parts_s + max(n_scenes, n_parallel) * scene_s
    start_s = min(times.begin.values()) - begin
    n_bytes = bytes_of.fixed + n_frames * bytes_of.frame + n_scenes * bytes_of.scene
    return Estimate(n_frames, start_s + work_s / n_parallel + finish_s, n_bytes)


def _sample(job: Job, left: list[int], n_trajectories: int) -> Job:
    """A job of up to `n_trajectories` unfinished trajectories, each with up to _N_FRAMES frames.

    The trajectories come from different scenes if possible.
    """
    first_of: dict[str, int] = {}
    for number in left:
        first_of.setdefault(job.plan.trajectories[number].scene_id, number)
    others = [number for number in left if number not in first_of.values()]
    chosen = [job.plan.trajectories[number] for number in sorted([*first_of.values(), *others][:n_trajectories])]
    of_scene: dict[str, list[int]] = {trajectory.scene_id: [] for trajectory in chosen}
    for index, trajectory in enumerate(chosen):
        of_scene[trajectory.scene_id].append(index)
    scenes = tuple(scene for scene in job.plan.scenes if scene.scene_id in of_scene)
    ranges = {scene_id: range(numbers[0], numbers[-1] + 1) for scene_id, numbers in of_scene.items()}
    trajectories = tuple(map(_thinned, chosen))
    return replace(job, plan=replace(job.plan, scenes=scenes, trajectories=trajectories, ranges=ranges))


def _thinned(trajectory: TrajectoryPlan) -> TrajectoryPlan:
    """A trajectory with up to _N_FRAMES of its frames, evenly spread from the first to the last."""
    n, flight = len(trajectory.splits), trajectory.flight
    indices = np.unique(np.linspace(0, n - 1, min(_N_FRAMES, n)).round().astype(int))
    arrays = (flight.time_s, flight.position_m, flight.velocity_mps, flight.rotation_wxyz)
    thinned = Flight(flight.nominal, *(array[indices] for array in arrays))
    return replace(
        trajectory,
        frame_index=tuple(trajectory.frame_index[i] for i in indices),
        splits=tuple(trajectory.splits[i] for i in indices),
        draw_flight=partial(_identity, thinned),
    )


def _identity(flight: Flight) -> Flight:
    return flight


@dataclass(frozen=True, slots=True)
class _Bytes:
    """Mean sizes in a rendered sample, bytes."""

    frame: float
    """Size of a frame's files and rows."""
    scene: float
    """Size of a scene's rows."""
    fixed: float
    """Size of the tables `frames` and `labels` and of the index without any rows."""

    @classmethod
    def of(cls, dataset: Dataset) -> "_Bytes":
        """The mean sizes in a finished sample."""
        images = sum(item.size_bytes for item in dataset.store.list("frames"))
        index = pa.concat_tables(
            pq.read_table(pa.BufferReader(dataset.store.read(part.path))) for part in dataset.info.index
        )
        rows = fixed = 0.0
        for table in (dataset.table("frames"), dataset.table("labels"), index.cast(INDEX)):
            whole, half = (_parquet_bytes(table.slice(0, n)) for n in (len(table), len(table) // 2))
            rows += 2 * (whole - half)
            fixed += max(2 * half - whole, 0)
        ground = sum(
            item.size_bytes
            for name in ("scenes", "craters", "boulders", "trajectories")
            for item in dataset.store.list(f"manifest/{name}")
        )
        return cls((images + rows) / dataset.info.counts.frames, ground / dataset.info.counts.scenes, fixed)


def _parquet_bytes(rows: pa.Table) -> int:
    sink = pa.BufferOutputStream()
    pq.write_table(rows, sink, compression="zstd")
    return sink.getvalue().size
