"""Frames per second of one machine by number of processes and threads: start-up and steady state.

Renders 160 frames of `tiny` with EXRs over two scenes, whose ground is in the cache, with one process of one thread,
with one process of two threads, and with two processes of one thread, each of which renders one scene. One process of
one thread is also restricted to one core, since a process develops each frame in a second thread. Each split is
rendered twice, in turn; the faster one counts. The control is a loop in Python without data: two processes against one
give the most that two cores of this machine can gain. Writes runs/bench/scale.json.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.figures import write_figures

SETTINGS = ("dataset.detect.n_scenes=2", "dataset.detect.trajectories_per_scene=2", "dataset.detect.n_frames=40")
N_FRAMES, N_SCENES = 160, 2
N_ROUNDS = 2
_CONTROL = "x = 0\nfor i in range(25_000_000): x += i & 7"


@dataclass(frozen=True, slots=True)
class Split:
    """How two cores are used."""

    n_processes: int
    """Number of processes."""
    n_threads: int
    """Number of threads of each process."""
    one_core: bool = False
    """Whether all processes share one core."""


SPLITS = {
    "one_core": Split(1, 1, one_core=True),
    "one_thread": Split(1, 1),
    "two_threads": Split(1, 2),
    "two_workers": Split(2, 1),
}


@dataclass(frozen=True, slots=True)
class Run:
    """Measurements of one split."""

    total_s: float
    """Time from the start of the processes to the end of the last one, seconds."""
    frames_per_s: float
    """All frames over this time."""
    start_s: float
    """Time until each process has written its first frame, seconds."""
    imports_s: float
    """Time until each process has imported all modules, seconds."""
    steady_frames_per_s: float
    """Frames per second from then until the first process has written its last frame."""
    cpu_s_per_frame: float
    """Processor time of a frame after the first frame, seconds."""
    start_cpu_s: float
    """Processor time of one process up to its first frame, seconds."""
    bytes_per_frame: float
    """Bytes of the dataset per frame."""


class Recorder:
    """A progress bar that records when frames are written, and the processor time at the first one."""

    def __init__(self) -> None:
        self.written_s: list[float] = []
        self.first_cpu_s = 0.0

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> None:
        """Ignored."""

    def advance(self, task_id: Any, advance: float = 1) -> None:
        """Record a frame."""
        if advance:
            self.first_cpu_s = self.first_cpu_s or time.process_time()
            self.written_s.append(time.monotonic())

    def update(self, task_id: Any, **fields: Any) -> None:
        """Ignored."""


def planned(n_threads: int):
    """The job of all frames."""
    from perilune_render.config import DatasetConfig
    from perilune_render.jobs.job import Job
    from perilune_shared.config import resolve

    settings = (*SETTINGS, f"dataset.render.threads={n_threads}")
    return Job.planned(resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, settings), "detect", "tiny")


def render(out: Path, n_threads: int, scenes: list[int]) -> dict[str, Any]:
    """Render some scenes, given by their indices, in this process; returns times and processor times, seconds."""
    from perilune_render.flight.plan import TrajectoryPlan
    from perilune_render.jobs.here import Here
    from perilune_render.jobs.run import render_job

    imported_s, recorder, job = time.monotonic(), Recorder(), planned(n_threads)
    own = tuple(job.plan.scenes[index] for index in scenes)
    trajectories: list[TrajectoryPlan] = []
    places = {}
    for scene in own:
        first = len(trajectories)
        trajectories += job.plan.of_scene(scene.scene_id)
        places[scene.scene_id] = range(first, len(trajectories))
    job = replace(job, plan=replace(job.plan, scenes=own, trajectories=trajectories, places=places))
    render_job(job, out, recorder, Here)
    return {
        "imported_s": imported_s,
        "written_s": recorder.written_s,
        "first_cpu_s": recorder.first_cpu_s,
        "cpu_s": time.process_time(),
    }


def measured(split: Split, out: Path) -> Run:
    """Render all frames with one split into new folders below `out`."""
    shares = [range(N_SCENES)[k :: split.n_processes] for k in range(split.n_processes)]
    cores = os.sched_getaffinity(0)
    start_s = time.monotonic()
    if split.one_core:
        os.sched_setaffinity(0, {max(cores)})
    processes = [
        _python("-m", "benchmarks.dataset.scale", str(out / str(k)), str(split.n_threads), *map(str, share))
        for k, share in enumerate(shares)
    ]
    os.sched_setaffinity(0, cores)
    found = [json.loads(_output(process).splitlines()[-1]) for process in processes]
    total_s = time.monotonic() - start_s
    first_s = max(each["written_s"][0] for each in found)
    last_s = min(each["written_s"][-1] for each in found)
    written = [time_s for each in found for time_s in each["written_s"]]
    assert len(written) == N_FRAMES
    n_bytes = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Run(
        total_s,
        N_FRAMES / total_s,
        first_s - start_s,
        max(each["imported_s"] for each in found) - start_s,
        sum(first_s < time_s <= last_s for time_s in written) / (last_s - first_s),
        sum(each["cpu_s"] - each["first_cpu_s"] for each in found) / (N_FRAMES - len(found)),
        sum(each["first_cpu_s"] for each in found) / len(found),
        n_bytes / N_FRAMES,
    )


def control_s(n_processes: int) -> float:
    """Time of the control in some processes at once, seconds."""
    start_s = time.monotonic()
    for process in [_python("-c", _CONTROL) for _ in range(n_processes)]:
        _output(process)
    return time.monotonic() - start_s


def _python(*arguments: str) -> subprocess.Popen:
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, text=True, env={**os.environ, **one_thread}
    )


def _output(process: subprocess.Popen) -> str:
    output = process.communicate()[0]
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, process.args)
    return output


def main() -> None:
    """Measure all splits and write the figures."""
    from perilune_render.terrain.cache import cached_scene

    job = planned(1)
    for scene in job.plan.scenes:
        cached_scene(job.config, job.plan.view, scene.seed)
    best: dict[str, Run] = {}
    loops_s: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(N_ROUNDS):
        for n_processes, times_s in loops_s.items():
            times_s.append(control_s(n_processes))
        for name, split in SPLITS.items():
            with tempfile.TemporaryDirectory() as folder:
                run = measured(split, Path(folder))
            print(name, run, file=sys.stderr, flush=True)
            best[name] = min(best.get(name, run), run, key=lambda each: each.total_s)
    figures: dict[str, object] = {"frames": N_FRAMES, "control_gain": 2 * min(loops_s[1]) / min(loops_s[2])}
    for name, run in best.items():
        figures |= {f"{name}_{field}": getattr(run, field) for field in Run.__slots__}
    for base in ("one_core", "one_thread"):
        for name in ("two_threads", "two_workers"):
            figures[f"{name}_over_{base}"] = best[base].total_s / best[name].total_s
            steady = best[name].steady_frames_per_s / best[base].steady_frames_per_s
            figures[f"{name}_over_{base}_steady"] = steady
    write_figures(Path("runs/bench/scale.json"), figures)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(render(Path(sys.argv[1]), int(sys.argv[2]), [int(index) for index in sys.argv[3:]])))
    else:
        main()
