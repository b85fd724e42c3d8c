"""Frames per second of `perilune-render develop` on one core.

Covers reading EXRs, sensor, PNG, hash and manifest. First renders a dataset with EXRs (256 x 256 px, small ground, half
a minute). Then develops it in this process on one core: with unchanged settings, and for a distorted camera, for
which the labels are computed again. Writes runs/bench/develop.json.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.develop import develop_dataset
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.job import Job
from perilune_render.jobs.run import render_job
from perilune_shared.config.resolve import resolve
from perilune_shared.console.terminal import progress_bar

SETTINGS = (
    "dataset.render.exr=true",
    "dataset.terrain.spacing_px=1.5",
    "dataset.detect.n_scenes=1",
    "dataset.detect.trajectories_per_scene=3",
    "dataset.detect.n_frames=50",
)
DISTORTED = (
    "dataset.camera.width_px=200",
    "dataset.camera.height_px=200",
    "dataset.camera.focal_length_px=275.0",
    "dataset.camera.distortion.k1=-0.1",
)
N_RUNS = 3


def main() -> None:
    """Run the benchmark on 150 frames."""
    config = resolve(DatasetConfig, "dataset", "perilune_render", "small", None, SETTINGS)
    with tempfile.TemporaryDirectory() as folder, progress_bar() as bar:
        source = render_job(Job.planned(config, "detect", "small"), Path(folder) / "source", bar, InProcess)
        core = min(os.sched_getaffinity(0))
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setaffinity(int(thread.name), {core})
        n = source.info.counts.frames
        seconds: dict[str, list[float]] = {"as it is": [], "distorted": []}
        cpu_s: dict[str, list[float]] = {"as it is": [], "distorted": []}
        for run in range(N_RUNS):
            for name, settings in (("as it is", ()), ("distorted", DISTORTED)):
                start, cpu_start = time.perf_counter(), time.process_time()
                made = develop_dataset(source, Path(folder) / f"{name} {run}", bar, None, settings)
                seconds[name].append(time.perf_counter() - start)
                cpu_s[name].append(time.process_time() - cpu_start)
                assert made.info.counts.frames == n
        png_bytes = made.table("frames", ["png_bytes"])["png_bytes"].to_numpy()
        exr_bytes = source.table("frames", ["exr_bytes"])["exr_bytes"].to_numpy()
    figures = {
        "frames": n,
        "frames_per_s": n / statistics.median(seconds["as it is"]),
        "frames_per_s_with_new_labels": n / statistics.median(seconds["distorted"]),
        # Per second of CPU time, so without the load of other programs.
        "frames_per_cpu_s": n / statistics.median(cpu_s["as it is"]),
        "frames_per_cpu_s_with_new_labels": n / statistics.median(cpu_s["distorted"]),
        "exr_bytes": float(exr_bytes.mean()),
        "png_bytes": float(png_bytes.mean()),
    }
    write_figures(Path("runs/bench/develop.json"), figures)


if __name__ == "__main__":
    main()
