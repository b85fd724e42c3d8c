"""Core hours and bytes of 34,300 frames, 1 million and 100 million, extrapolated from ten frames that are rendered.

Uses the estimate of `--dry-run` for the preset `paper` with one worker of one thread, with 100 frames of a trajectory
and, for the larger two, 100 trajectories of a scene. Also writes and reads an index of one million files, as the last
step of a rendering does. Writes runs/bench/scaling.json.
"""

import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from rich.progress import Progress

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.jobs.estimate import estimate
from perilune_render.jobs.job import Job
from perilune_render.jobs.local import LocalWorkers
from perilune_shared.config.resolve import resolve
from perilune_shared.dataset.index import INDEX, read_index, write_index
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.storage.store import open_store

SIZES = {"34300": (1, 343), "1000000": (100, 100), "100000000": (10_000, 100)}
"""Numbers of scenes and of trajectories of each, by number of frames."""


N_FILES = 1_000_000
"""Number of files in the index."""


def index_figures() -> dict[str, float]:
    """Time of writing and reading an index of one million files, and its bytes on the disk and in memory."""
    digest = np.random.default_rng(1).integers(0, 256, (N_FILES, 32), np.uint8)
    paths = [
        f"frames/scene-{i // 10_000:04d}/trajectory-{i // 100 % 100:04d}/{i % 100:06d}.png" for i in range(N_FILES)
    ]
    hashes = [row.tobytes().hex() for row in digest]
    rows = pa.table([paths, [60_000] * N_FILES, hashes], schema=INDEX)
    with tempfile.TemporaryDirectory() as folder:
        store = open_store(folder)
        begin_s = time.perf_counter()
        parts = write_index(store, rows)
        written_s = time.perf_counter()
        info = DatasetInfo.model_construct(index=parts)
        assert read_index(store, info).num_rows == N_FILES
        read_s = time.perf_counter()
    return {
        "files": N_FILES,
        "write_s": written_s - begin_s,
        "read_s": read_s - written_s,
        "bytes": sum(part.bytes for part in parts),
        "bytes_in_memory": rows.nbytes,
    }


def main() -> None:
    """Estimate each size and write the figures."""
    figures: dict[str, object] = {"index": index_figures()}
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
