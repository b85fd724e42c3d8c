"""Requests and bytes of a frame, rendered to an S3 server on this machine.

Renders the detection dataset of `tiny` to moto's server, in this process, and counts the requests that are sent.
Writes runs/bench/requests.json.
"""

import os
from collections import Counter
from pathlib import Path
from typing import Any

from rich.progress import Progress
from tests.helpers.s3_server import new_bucket, s3_server

from benchmarks.figures import write_figures


def main() -> None:
    """Render, count and write the figures."""
    with s3_server() as environment:
        os.environ.update(environment)
        from aiobotocore.endpoint import AioEndpoint

        from perilune_render.config import DatasetConfig
        from perilune_render.jobs.here import Here
        from perilune_render.jobs.job import Job
        from perilune_render.jobs.run import render_job
        from perilune_shared.config import resolve

        counts: Counter[str] = Counter()
        send = AioEndpoint._send

        async def counted(endpoint: Any, request: Any) -> Any:
            counts[request.method] += 1
            return await send(endpoint, request)

        AioEndpoint._send = counted
        job = Job.planned(resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, ()), "detect", "tiny")
        made = render_job(job, f"{new_bucket()}/moon", Progress(disable=True), Here)
        AioEndpoint._send = send
        stored = sum(item.size_bytes for item in made.store.list())
    n_frames = made.info.counts.frames
    figures = {
        "frames": n_frames,
        "trajectories": made.info.counts.trajectories,
        "requests": dict(counts),
        "requests_per_frame": counts.total() / n_frames,
        "bytes_stored_per_frame": stored / n_frames,
    }
    write_figures(Path("runs/bench/requests.json"), figures)


if __name__ == "__main__":
    main()
