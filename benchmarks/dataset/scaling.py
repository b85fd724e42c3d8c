"""Core hours and bytes of 34,300 frames, 1 million and 100 million, extrapolated from ten frames that are rendered.

Uses the estimate of `--dry-run` for the preset `paper` with one worker of one thread, with 100 frames of a trajectory
and, for the larger two, 100 trajectories of a scene. Writes runs/bench/scaling.json.
"""

import time
from functools import partial
from pathlib import Path

from rich.progress import Progress

from benchmarks.figures import write_figures
from perilune_render.config import DatasetConfig
from perilune_render.jobs.estimate import estimate
from perilune_render.jobs.job import Job
from perilune_render.jobs.local import LocalWorkers
from perilune_shared.config import resolve

SIZES = {"34300": (1, 343), "1000000": (100, 100), "100000000": (10_000, 100)}
"""Numbers of scenes and of trajectories of each, by number of frames."""


def main() -> None:
    """Estimate each size and write the figures."""
    figures: dict[str, object] = {}
    for name, (n_scenes, n_trajectories) in SIZES.items():
        numbers = {"n_scenes": n_scenes, "trajectories_per_scene": n_trajectories, "n_frames": 100}
        chosen = tuple(f"dataset.detect.{key}={number}" for key, number in numbers.items())
        config = resolve(DatasetConfig, "dataset", "perilune_render", "paper", None, chosen)
        begin_s = time.perf_counter()
        job = Job.planned(config, "detect", "paper").with_threads(1, 1)
        found = estimate(job, f"memory://{name}", Progress(disable=True), partial(LocalWorkers, n_workers=1), 1)
        assert found.n_frames == int(name)
        figures[name] = {
            "scenes": n_scenes,
            "trajectories": n_scenes * n_trajectories,
            "core_hours": found.seconds / 3600,
            "gigabytes": found.n_bytes / 1e9,
            "estimating_s": time.perf_counter() - begin_s,
        }
        print(name, figures[name], flush=True)
    write_figures(Path("runs/bench/scaling.json"), figures)


if __name__ == "__main__":
    main()
