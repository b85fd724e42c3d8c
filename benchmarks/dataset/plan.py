"""Time and peak memory of planning 10 million frames.

Makes the plan, goes through all trajectories (names, seeds, splits) and makes the checks that come before rendering,
each plan in a process of its own. Writes runs/bench/plan.json.
"""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.flight.plan import make_plan
from perilune_render.flight.pose_checks import check_plan
from perilune_render.terrain.grid import graded_grid
from perilune_shared.config.resolve import resolve

PLANS = {"1000 scenes": (1000, 100, 100, "frame"), "100000 scenes": (100_000, 1, 100, "scene")}
"""Numbers of scenes, of trajectories per scene and of frames per trajectory, and the unit of the split."""


def plan_once(n_scenes: int, n_trajectories: int, n_frames: int, split_by: str) -> dict[str, float]:
    """Make one plan in this process; returns times in seconds and peak memory in GiB."""
    settings = {
        "n_scenes": n_scenes,
        "trajectories_per_scene": n_trajectories,
        "n_frames": n_frames,
        "split_by": split_by,
    }
    chosen = tuple(f"dataset.detect.{name}={value}" for name, value in settings.items())
    config = resolve(DatasetConfig, "dataset", "perilune_render", "large", None, chosen)
    start = time.perf_counter()
    plan = make_plan(config, "detect")
    planned = time.perf_counter()
    assert sum(len(trajectory.splits) for trajectory in plan.trajectories) == n_scenes * n_trajectories * n_frames
    seen = time.perf_counter()
    check_plan(plan, graded_grid(config.terrain, plan.view), "configuration")
    checked = time.perf_counter()
    return {
        "plan_s": planned - start,
        "trajectories_s": seen - planned,
        "checks_s": checked - seen,
        "all_s": checked - start,
        "cpu_s": time.process_time(),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    """Run the benchmark."""
    figures: dict[str, float] = {}
    for name, numbers in PLANS.items():
        command = [sys.executable, "-m", "benchmarks.dataset.plan", json.dumps(numbers)]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        figures |= {f"{name}/{key}": value for key, value in found.items()}
    write_figures(Path("runs/bench/plan.json"), figures)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(plan_once(*json.loads(sys.argv[1]))))
    else:
        main()
