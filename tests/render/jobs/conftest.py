"""A small job, its settings and its dataset."""

import pytest
from rich.progress import Progress

from perilune_render.config.dataset import DatasetConfig
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.job import Job
from perilune_render.jobs.run import render_job
from perilune_shared.config.resolve import resolve

# What processes, shards and stores do to a rendering does not depend on its engine. test_other_processor.py and
# test_render.py compare datasets that Blender rendered in several processes.
QUICK = (
    "dataset.render.engine=heightfield",
    "dataset.camera.width_px=32",
    "dataset.camera.height_px=32",
    "dataset.terrain.spacing_px=2.0",
    "dataset.render.threads=1",
    "dataset.detect.n_scenes=2",
    "dataset.detect.trajectories_per_scene=2",
    "dataset.detect.n_frames=12",
)


@pytest.fixture(scope="session")
def options():
    """Options of `perilune-render dataset` that give the job."""
    return ["--preset", "tiny", "--kind", "detect", *(part for each in QUICK for part in ("--set", each))]


@pytest.fixture(scope="session")
def job():
    config = resolve(DatasetConfig, "dataset", "perilune_render", "tiny", None, QUICK)
    return Job.planned(config, "detect", "tiny")


@pytest.fixture(scope="session")
def files_of():
    """Function from a folder to the content of each file in it, by relative path."""
    return lambda root: {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.fixture(scope="session")
def whole(job, files_of, tmp_path_factory):
    """Files of the job's dataset, rendered in this process without interruption."""
    out = tmp_path_factory.mktemp("whole")
    render_job(job, out, Progress(disable=True), InProcess)
    return files_of(out)
