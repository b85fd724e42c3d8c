"""Resident memory of a process that renders 5000 frames, from frame 200 on.

Renders trajectories of 100 frames of 16 x 16 px over coarse ground, ten in each scene, as a worker does. Measures the
resident memory after every tenth frame. `growth` compares its mean over the last scene with that over the first scene,
from frame 200 on (the first two trajectories warm up). Writes runs/bench/memory.json.
"""

import os
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.job import Job
from perilune_render.jobs.run import render_job
from perilune_shared.config.resolve import resolve

WARM_UP = 200
"""Number of frames before the first measurement counts."""
PER_SCENE = 10
"""Number of trajectories, of 100 frames each, over each scene."""
SETTINGS = (
    "dataset.camera={width_px: 16, height_px: 16}",
    "dataset.terrain.spacing_px=1.0",
    "dataset.labels.min_radius_px=1.0",
    "dataset.render.samples=1",
    "dataset.render.threads=1",
    "dataset.render.cache_gib=0",
    f"dataset.detect.trajectories_per_scene={PER_SCENE}",
    "dataset.detect.n_frames=100",
)


def resident_mib() -> float:
    """Resident memory of this process, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@dataclass
class Measured:
    """A progress bar that measures the memory after every tenth frame."""

    n_frames: int = 0
    """Number of frames rendered."""
    mib: dict[int, float] = field(default_factory=dict)
    """Resident memory, MiB, by number of frames rendered."""

    def add_task(self, description: str, *, total: float | None, **fields: Any) -> None:
        """Nothing to show."""

    def update(self, task_id: Any, **fields: Any) -> None:
        """Nothing to show."""

    def advance(self, task_id: Any, advance: float = 1) -> None:
        """Count frames."""
        self.n_frames += int(advance)
        if advance and self.n_frames % 10 == 0:
            self.mib[self.n_frames] = resident_mib()
            if self.n_frames % 500 == 0:
                print(f"{self.n_frames} frames: {self.mib[self.n_frames]:.1f} MiB", flush=True)


def main(n_frames: int) -> None:
    """Run the benchmark; `n_frames` is a multiple of 1000."""
    n_scenes = n_frames // (100 * PER_SCENE)
    chosen = (*SETTINGS, f"dataset.detect.n_scenes={n_scenes}")
    config = resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, chosen)
    measured = Measured()
    with tempfile.TemporaryDirectory() as folder:
        render_job(Job.planned(config, "detect", "tiny"), Path(folder) / "made", measured, InProcess)
    frames, mib = np.array(list(measured.mib)), np.array(list(measured.mib.values()))
    first = mib[(frames >= WARM_UP) & (frames <= 100 * PER_SCENE)].mean()
    last = mib[frames > n_frames - 100 * PER_SCENE].mean()
    figures = {
        "frames": n_frames,
        "scenes": n_scenes,
        "mib_at_frame_200": measured.mib[WARM_UP],
        "mib_at_the_end": measured.mib[n_frames],
        "growth": last / first - 1,
        "largest_mib_after_frame_200": float(mib[frames >= WARM_UP].max()),
        "mib": {str(n): measured.mib[n] for n in range(WARM_UP, n_frames + 1, 200)},
    }
    write_figures(Path("runs/bench/memory.json"), figures)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5000)
