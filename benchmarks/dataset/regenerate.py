"""Number of frames that are byte-identical when they are rendered again from the manifest alone.

Renders 30 frames of three scenes of `small`, then again from their tables, with terrain generated again. Writes
runs/bench/regenerate.json.
"""

import os
import tempfile
from pathlib import Path
from typing import get_args

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.regenerate import State, regenerate, spread
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.job import Job
from perilune_render.jobs.run import render_job
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar

SETTINGS = ("dataset.detect.n_scenes=3", "dataset.detect.trajectories_per_scene=1", "dataset.detect.n_frames=10")


def main() -> None:
    """Run the benchmark."""
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small", None, SETTINGS)
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        root = Path(folder)
        os.environ["PERILUNE_CACHE"] = str(root / "cache")
        dataset = render_job(Job.planned(config, "detect", "small"), root / "made", bar, InProcess)
        n = dataset.info.counts.frames
        os.environ["PERILUNE_CACHE"] = str(root / "other cache")
        outcomes = regenerate(dataset, spread(dataset, n), root / "again", bar)
    figures = {
        "frames": n,
        **{state: sum(outcome.state == state for outcome in outcomes) for state in get_args(State)},
        "same_ground": all(outcome.same_ground for outcome in outcomes),
    }
    write_figures(Path("runs/bench/regenerate.json"), figures)


if __name__ == "__main__":
    main()
