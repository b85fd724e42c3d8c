"""Rendering in worker processes: the same bytes as in one process, also when workers are killed."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from rich.progress import Progress

from perilune_render.dataset.work import committed
from perilune_render.jobs import local, worker
from perilune_render.jobs.in_process import InProcess
from perilune_render.jobs.local import LocalWorkers
from perilune_render.jobs.run import RenderingFailed, render_job
from perilune_render.jobs.scene_renderer import SceneRenderer
from perilune_render.jobs.worker import early_worker
from perilune_shared import cgroups
from perilune_shared.dataset.manifest import open_dataset
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store
from perilune_shared.validation.validate import validate


@pytest.fixture
def kill(tmp_path_factory, monkeypatch):
    """Function that lets the worker of the second trajectory kill itself `n_kills` times, within the trajectory."""

    def kill(n_kills):
        kills = tmp_path_factory.mktemp("kills")
        for k in range(n_kills):
            kills.joinpath(str(k)).touch()
        monkeypatch.setenv("KILLS", str(kills))
        monkeypatch.setattr(worker, "WORKER", (str(Path(__file__).with_name("killed_worker.py")),))

    return kill


def two_workers(job, out):
    return LocalWorkers(job, out, 2)


@pytest.mark.slow
def test_two_workers_one_killed_and_all_recycled_give_the_same_bytes(
    job, whole, files_of, tmp_path, monkeypatch, kill, capsys
):
    monkeypatch.setattr(local, "RECYCLED_AFTER", 1)
    kill(1)
    render_job(job, tmp_path, Progress(disable=True), two_workers)
    assert files_of(tmp_path) == whole and len(whole) > 20
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "warning: scene-0000/trajectory-0001: worker killed by SIGKILL; trying again (3 left)"


def test_a_worker_that_was_started_early_renders_and_its_successor_too(job, whole, files_of, tmp_path):
    with early_worker(job.config.render.engine) as early:
        first = LocalWorkers(job, open_store(tmp_path / "first"), 1, early)
        render_job(job, tmp_path / "first", Progress(disable=True), lambda *_: first)
        assert early.ready and early.process.poll() is not None
        render_job(job, tmp_path / "second", Progress(disable=True), lambda *of: LocalWorkers(*of, 1, early))
    assert files_of(tmp_path / "first") == files_of(tmp_path / "second") == whole


def test_an_early_worker_ends_with_its_block():
    with pytest.raises(UserError), early_worker("heightfield") as early:
        raise UserError("file", "field", "found", "expected")
    assert early.process.poll() is not None


@pytest.mark.slow
def test_a_trajectory_that_always_fails_is_named_and_all_others_are_rendered(job, whole, files_of, tmp_path, kill):
    kill(99)
    with pytest.raises(RenderingFailed) as failed:
        render_job(job, tmp_path, Progress(disable=True), two_workers)
    assert failed.value.errors == {"scene-0000/trajectory-0001": "worker killed by SIGKILL"}
    dataset = open_dataset(tmp_path)
    assert not dataset.info.complete and len(committed(dataset.store)) == 3
    render_job(job, tmp_path, Progress(disable=True), InProcess)
    assert files_of(tmp_path) == whole and validate(open_dataset(tmp_path)) == []


def test_code_that_changed_since_the_beginning_is_refused(job, tmp_path):
    recipe = job.info.recipe()
    other = recipe.model_copy(update={"versions": {**recipe.versions, "imaging": "0" * 16}})
    changed = replace(job, info=job.info.model_copy(update={"recipes": {other.key: other}}))
    with pytest.raises(UserError, match=r"perilune_render: versions: got imaging .* expected the code that"):
        SceneRenderer(changed, open_store(tmp_path))


@pytest.mark.parametrize(
    ("n_cores", "n_threads", "free_gib", "n_workers"),
    [(2, None, 100, 2), (3, None, 100, 3), (16, None, 100, 4), (3, 2, 100, 1), (3, None, 1.9, 2), (3, None, 0.1, 1)],
)
def test_default_is_a_worker_for_each_core_as_trajectories_and_memory_allow(
    n_cores, n_threads, free_gib, n_workers, job, monkeypatch
):
    job = replace(
        job, config=job.config.model_copy(update={"render": job.config.render.model_copy(update={"threads": 0})})
    )
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(n_cores)))
    monkeypatch.setattr(local, "_free_bytes", lambda: free_gib * 2**30)
    assert local.default_workers(job, n_threads) == n_workers


def test_free_memory_is_that_of_the_container_if_it_is_less(tmp_path, monkeypatch):
    monkeypatch.setattr(cgroups, "_ROOT", tmp_path)
    of_machine = local._free_bytes()
    assert 2**27 < of_machine < 2**45
    tmp_path.joinpath("memory.max").write_text("max\n")
    tmp_path.joinpath("memory.current").write_text("1000\n")
    assert local._free_bytes() == pytest.approx(of_machine, rel=0.5)
    tmp_path.joinpath("memory.max").write_text("5000\n")
    assert local._free_bytes() == 4000
