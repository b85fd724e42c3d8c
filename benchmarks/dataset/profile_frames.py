"""Where the time of a frame goes: processor time of each step of `perilune-render dataset` with the engine heightfield.

Renders trajectories of `small` in this process with one thread for the rays, and adds up the processor time of each
step. Steps run in two threads, as in a dataset; the time of a step is that of its own thread. Preparing a scene is
stated apart: it is paid once for all frames over it. Writes runs/bench/profile_frames.json.
"""

import argparse
import functools
import pkgutil
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.figures import write_figures
from perilune_render.config.dataset import DatasetConfig
from perilune_render.jobs.job import Job
from perilune_render.jobs.scene_renderer import SceneRenderer
from perilune_shared.config.resolve import resolve
from perilune_shared.storage.store import open_store

PREPARATION = {
    "generate or read the ground": "perilune_render.jobs.scene_renderer.cached_scene",
    "arrays for the rays": "perilune_render.engines.heightfield.engine.surface_of",
    "raster of largest heights": "perilune_render.engines.heightfield.engine.tops_of",
    "horizon towards the Sun": "perilune_render.engines.heightfield.engine.horizon_of",
}
"""Steps for each scene."""
FRAME = {
    "rays, shadow rays, shading": "perilune_render.engines.heightfield.engine.see",
    "photometry": "perilune_render.engines.heightfield.engine.reflected",
    "random numbers of the samples": "perilune_render.engines.heightfield.engine.HeightfieldEngine._drawn",
    "points of the Sun's disc": "perilune_render.engines.heightfield.engine.disc_places",
    "sensor": "perilune_render.engines.frame_source.FrameSource.develop",
    "PNG": "perilune_render.dataset.frame_files.png_bytes",
    "write and hash files": "perilune_render.dataset.trajectory.write_frame",
    "labels": "perilune_render.engines.frame_source.FrameSource.labels",
    "share of real ground": "perilune_render.dataset.trajectory.real_ground_share",
    "rows of labels": "perilune_render.dataset.trajectory.tables.label_table",
    "inertial measurements and ranges": "perilune_render.dataset.trajectory.tables.measurement_tables",
    "Parquet": "perilune_render.dataset.trajectory.commit",
}
"""Steps for each frame, or for each trajectory. The time of a step does not include steps that it calls."""


class Clock:
    """Adds up the processor time of functions by name, excluding timed functions that they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._lock, self._inner = threading.Lock(), threading.local()

    def timed(self, name: str, function: Callable) -> Callable:
        """The function, timed."""

        @functools.wraps(function)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            outer, self._inner.s = getattr(self._inner, "s", 0.0), 0.0
            start = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.thread_time() - start
                with self._lock:
                    self.seconds[name] += spent - self._inner.s
                self._inner.s = outer + spent

        return wrapper


@contextmanager
def timed(clock: Clock, steps: dict[str, str]) -> Iterator[None]:
    """Time functions, given by their full names."""
    with ExitStack() as stack:
        for name, target in steps.items():
            stack.enter_context(mock.patch(target, clock.timed(name, pkgutil.resolve_name(target))))
        yield


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dataset.profile_frames")
    parser.add_argument("--preset", default="small")
    parser.add_argument("--kind", choices=("detect", "nav"), default="detect")
    parser.add_argument("--scenes", type=int, default=2)
    given = parser.parse_args()
    settings = (
        f"dataset.{given.kind}.n_scenes={given.scenes}",
        "dataset.render.engine=heightfield",
        "dataset.render.threads=1",
    )
    config = resolve(DatasetConfig, "dataset", "perilune_render", given.preset, settings=settings)
    job = Job.planned(config, given.kind, given.preset)
    clock, n_frames = Clock(), 0
    with tempfile.TemporaryDirectory() as folder, SceneRenderer(job, open_store(folder)) as renderer:
        # Compiled code is loaded before.
        renderer.render(0, lambda: None, lambda _: None)
        renderer.close()
        with timed(clock, PREPARATION | FRAME):
            start = time.process_time()
            for place in range(len(job.plan.trajectories)):
                renderer.render(place, lambda: None, lambda _: None)
                n_frames += job.n_frames(place)
            total_s = time.process_time() - start
    n_scenes = len(job.plan.scenes)
    scene = {name: clock.seconds[name] / n_scenes for name in PREPARATION}
    frame = {name: clock.seconds[name] / n_frames for name in FRAME}
    frame["other"] = (total_s - sum(clock.seconds.values())) / n_frames
    figures = {"preset": given.preset, "kind": given.kind, "scenes": n_scenes, "frames": n_frames}
    figures |= {"total_s": total_s, "frame_s": sum(frame.values()), "scene_s": sum(scene.values())}
    write_figures(
        Path("runs/bench/profile_frames.json"), {**figures, "seconds_of_a_scene": scene, "seconds_of_a_frame": frame}
    )


if __name__ == "__main__":
    main()
