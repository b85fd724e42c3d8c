"""Frames per second of one machine by executor, number of processes and threads: start-up and steady state.

Renders 160 frames of `tiny` with EXRs, 16 trajectories over two scenes whose ground is in the cache, by the command
`perilune-render dataset`: in its own process, with one and two workers, and with Ray on clusters of one, two and three
nodes of one core each, which are started before. The own process is also restricted to one core, since it develops each
frame in a second thread. Each split is rendered twice, in turn; the faster one counts. The control is a loop in Python
without data: two processes against one give the most that two cores of this machine can gain. Writes
runs/bench/scale.json.

    python -m benchmarks.dataset.scale                                              # two rounds of all splits
    python -m benchmarks.dataset.scale --rounds 5 --split two_workers --split ray_two_nodes
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.figures import write_figures
from benchmarks.ray_cluster import LocalCluster

N_SCENES, N_TRAJECTORIES, N_FRAMES = 2, 8, 10
"""Number of scenes, of trajectories over each, and of frames of each."""
COMMAND = [
    str(Path(sys.executable).parent / "perilune-render"),
    *("dataset", "--preset", "tiny", "--kind", "detect"),
    *("--set", f"dataset.detect.n_scenes={N_SCENES}"),
    *("--set", f"dataset.detect.trajectories_per_scene={N_TRAJECTORIES}"),
    *("--set", f"dataset.detect.n_frames={N_FRAMES}"),
]
TOTAL = N_SCENES * N_TRAJECTORIES * N_FRAMES
"""Number of frames of a run."""
_CONTROL = "x = 0\nfor i in range(25_000_000): x += i & 7"


@dataclass(frozen=True, slots=True)
class Split:
    """How the cores are used."""

    options: tuple[str, ...]
    """Options of the command."""
    n_processes: int = 1
    """Number of processes that render."""
    n_nodes: int = 0
    """Number of nodes of the Ray cluster; 0 without Ray."""
    one_core: bool = False
    """Whether the command is restricted to one core."""


SPLITS = {
    "one_core": Split(("--workers", "0", "--threads", "1"), one_core=True),
    "one_thread": Split(("--workers", "0", "--threads", "1")),
    "two_threads": Split(("--workers", "0", "--threads", "2")),
    "one_worker": Split(("--workers", "1", "--threads", "1")),
    "two_workers": Split(("--workers", "2", "--threads", "1"), 2),
    "ray_one_node": Split(("--executor", "ray"), 1, n_nodes=1),
    "ray_two_nodes": Split(("--executor", "ray"), 2, n_nodes=2),
    "ray_three_nodes": Split(("--executor", "ray"), 3, n_nodes=3),
}


@dataclass(frozen=True, slots=True)
class Run:
    """Measurements of one split."""

    total_s: float
    """Time from the start of the command to its end, seconds."""
    frames_per_s: float
    """All frames over this time."""
    start_s: float
    """Time from the start of the command to its first frame, seconds."""
    steady_frames_per_s: float
    """Frames per second from when every process has written a frame until the first process finds no more work."""
    finish_s: float
    """Time from the last frame to the end of the command, seconds."""
    bytes_per_frame: float
    """Bytes of the dataset per frame."""


def measured(split: Split, out: Path) -> Run:
    """Render all frames with one split into a new folder."""
    if not split.n_nodes:
        return _timed(split, out)
    with LocalCluster(split.n_nodes) as cluster:
        return _timed(split, out, "--address", cluster.address)


def _timed(split: Split, out: Path, *options: str) -> Run:
    cores = os.sched_getaffinity(0)
    begin_s = time.time()
    if split.one_core:
        os.sched_setaffinity(0, {max(cores)})
    try:
        process = subprocess.Popen([*COMMAND, *split.options, *options, "--out", str(out)], stdout=subprocess.DEVNULL)
    finally:
        os.sched_setaffinity(0, cores)
    if process.wait():
        raise subprocess.CalledProcessError(process.returncode, process.args)
    end_s = time.time()
    # The files say when they were written, whichever process wrote them.
    frames = [path for path in out.joinpath("detect", "frames").rglob("*.png")]
    assert len(frames) == TOTAL
    written: dict[Path, list[float]] = {}
    for path in frames:
        written.setdefault(path.parent, []).append(path.stat().st_mtime)
    times_s = sorted(time_s for each in written.values() for time_s in each)
    all_busy_s = sorted(map(min, written.values()))[split.n_processes - 1]
    one_idle_s = sorted(map(max, written.values()))[-split.n_processes]
    return Run(
        end_s - begin_s,
        TOTAL / (end_s - begin_s),
        times_s[0] - begin_s,
        sum(all_busy_s < time_s <= one_idle_s for time_s in times_s) / (one_idle_s - all_busy_s),
        end_s - times_s[-1],
        sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / TOTAL,
    )


def control_s(n_processes: int) -> float:
    """Time of the control in some processes at once, seconds."""
    start_s = time.monotonic()
    processes = [subprocess.Popen([sys.executable, "-c", _CONTROL]) for _ in range(n_processes)]
    assert not any(process.wait() for process in processes)
    return time.monotonic() - start_s


def main() -> None:
    """Measure the splits and write the figures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dataset.scale")
    parser.add_argument("--rounds", type=int, default=2, help="number of renderings of each split")
    parser.add_argument("--split", action="append", choices=SPLITS, help="split to measure, by default all; repeatable")
    options = parser.parse_args()
    chosen = {name: split for name, split in SPLITS.items() if name in (options.split or SPLITS)}
    with tempfile.TemporaryDirectory() as folder:  # fills the caches of scenes and compiled code
        measured(SPLITS["one_worker"], Path(folder))
    best: dict[str, Run] = {}
    loops_s: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(options.rounds):
        for n_processes, times_s in loops_s.items():
            times_s.append(control_s(n_processes))
        for name, split in chosen.items():
            with tempfile.TemporaryDirectory() as folder:
                run = measured(split, Path(folder))
            print(name, run, file=sys.stderr, flush=True)
            best[name] = min(best.get(name, run), run, key=lambda each: each.total_s)
    figures: dict[str, object] = {"frames": TOTAL, "control_gain": 2 * min(loops_s[1]) / min(loops_s[2])}
    for name, run in best.items():
        figures |= {f"{name}_{field}": getattr(run, field) for field in Run.__slots__}
    pairs = [(name, base) for base in ("one_core", "one_thread") for name in ("two_threads", "two_workers")]
    for name, base in [*pairs, ("ray_one_node", "one_worker"), ("ray_two_nodes", "two_workers")]:
        if name not in best or base not in best:
            continue
        figures[f"{name}_over_{base}"] = best[base].total_s / best[name].total_s
        figures[f"{name}_over_{base}_steady"] = best[name].steady_frames_per_s / best[base].steady_frames_per_s
    write_figures(Path("runs/bench/scale.json"), figures)


if __name__ == "__main__":
    main()
