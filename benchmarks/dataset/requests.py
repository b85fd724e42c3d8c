"""Requests of a frame, a trajectory, a scene and a dataset, rendered to an S3 server on this machine.

Renders four small datasets to moto's server, in this process, and counts the requests that are sent. They differ in the
numbers of frames, trajectories and scenes, which gives the requests of each. Those of a record of progress, one for
each ten seconds of a process, are left out. Writes runs/bench/requests.json.
"""

import os
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from rich.progress import Progress
from tests.helpers.s3_server import new_bucket, s3_server

from benchmarks.figures import write_figures

FEW, MANY = 16, 24
"""Numbers of frames of a trajectory; the overview shows 12."""
DATASETS = {"base": (1, 1, FEW), "frames": (1, 1, MANY), "trajectories": (1, 2, FEW), "scenes": (2, 1, FEW)}
"""Numbers of scenes, of trajectories of each, and of frames of each."""
METHODS = ("GET", "HEAD", "PUT", "POST", "DELETE")


def settings(n_scenes: int, n_trajectories: int, n_frames: int) -> tuple[str, ...]:
    """Settings of a dataset of frames of 32 x 32 pixels."""
    numbers = {"n_scenes": n_scenes, "trajectories_per_scene": n_trajectories, "n_frames": n_frames}
    camera = ("dataset.camera.width_px=32", "dataset.camera.height_px=32", "dataset.terrain.spacing_px=2.0")
    split = ("dataset.detect.split_by=frame", "dataset.render.exr=false")
    return (*camera, *split, *(f"dataset.detect.{name}={number}" for name, number in numbers.items()))


def counted(cache: str, n_scenes: int, n_trajectories: int, n_frames: int) -> Counter[str]:
    """Render one dataset with a new cache of scenes; returns the number of requests by method."""
    from aiobotocore.endpoint import AioEndpoint

    from perilune_render.config.dataset import DatasetConfig
    from perilune_render.jobs import records
    from perilune_render.jobs.in_process import InProcess
    from perilune_render.jobs.job import Job
    from perilune_render.jobs.run import render_job
    from perilune_shared.config.resolve import resolve

    records._INTERVAL_S = 3600.0
    found: Counter[str] = Counter()
    send = AioEndpoint._send

    async def counting(endpoint: Any, request: Any) -> Any:
        if "/work/claims/" not in request.url:  # renewed by the clock
            found[request.method] += 1
        return await send(endpoint, request)

    AioEndpoint._send = counting
    chosen = settings(n_scenes, n_trajectories, n_frames)
    job = Job.planned(resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, chosen), "detect", "tiny")
    os.environ["PERILUNE_CACHE"] = cache
    try:
        render_job(job, f"{new_bucket()}/moon", Progress(disable=True), InProcess)
    finally:
        AioEndpoint._send = send
    return found


def main() -> None:
    """Render, count and write the figures."""
    with s3_server() as environment:
        os.environ.update(environment)
        found = {}
        for name, numbers in DATASETS.items():
            with tempfile.TemporaryDirectory() as cache:
                found[name] = counted(cache, *numbers)
    figures: dict[str, object] = {}
    for method in METHODS:
        base = found["base"][method]
        frame = (found["frames"][method] - base) / (MANY - FEW)
        trajectory = found["trajectories"][method] - base - FEW * frame
        scene = found["scenes"][method] - base - FEW * frame - trajectory
        dataset = base - FEW * frame - trajectory - scene
        figures[method] = {"frame": frame, "trajectory": trajectory, "scene": scene, "dataset": dataset}
    write_figures(Path("runs/bench/requests.json"), figures)


if __name__ == "__main__":
    main()
