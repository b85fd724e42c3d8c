"""Rendering with Ray on this machine: the same bytes as in one process, also when a process of Ray is killed."""

import os
import signal
from functools import partial
from pathlib import Path

import pytest
from rich.progress import Progress
from tests.helpers import in_process

from perilune_render.cli.main import main
from perilune_render.jobs.run import render_job
from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

pytest.importorskip("ray", reason="needs Ray (extra `ray`)")


def processes_named(word):
    """Ids of the processes of this user whose command line begins with a word."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.joinpath("cmdline").read_bytes().startswith(word.encode()):
                found.append(int(folder.name))
        except OSError:
            continue
    return found


class KillsOnce(Progress):
    """A progress bar that kills the processes of Ray that hold a renderer, when the first trajectory is finished."""

    killed = False

    def advance(self, task_id, advance=1):
        super().advance(task_id, advance)
        if advance == 1 and not self.killed:
            self.killed = [os.kill(pid, signal.SIGKILL) for pid in processes_named("ray::_Renderer")] != []


@pytest.mark.slow
def test_ray_gives_the_same_bytes_on_s3_although_its_processes_are_killed(job, whole, s3_bucket, capsys):
    from perilune_render.jobs.ray_actors import RayActors

    progress, out = KillsOnce(disable=True), open_store(f"{s3_bucket}/moon")
    render_job(job, out, progress, partial(RayActors, n_workers=2, address=None))
    assert {item.path: out.read(item.path) for item in out.list()} == whole
    assert progress.killed and "a process of Ray was lost (ActorDiedError); trying again" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("configured", "given", "n_threads"),
    [(0, [], 1), (0, ["--workers", "2"], 1), (3, [], 3), (3, ["--threads", "2"], 2)],
)
def test_a_process_has_one_thread_unless_more_are_given(configured, given, n_threads, options, monkeypatch, tmp_path):
    """Those of the other machines' cores that Ray reserves for it; the cores of this machine do not matter."""
    from perilune_render.jobs import ray_actors

    class Stops(ray_actors.RayActors):
        def __enter__(self):
            assert self._n_threads == self._job.config.render.threads
            raise UserError("Ray", "threads", self._n_threads, "nothing else")

    monkeypatch.setattr(ray_actors, "RayActors", Stops)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    chosen = [*options, "--set", f"dataset.render.threads={configured}", "--executor", "ray", *given]
    done = in_process.call(main, "dataset", *chosen, "--out", tmp_path / "moon")
    assert f"Ray: threads: got {n_threads}," in done.stderr


def test_ctrl_c_while_ray_starts_ends_it_when_it_has_started(job, monkeypatch, tmp_path):
    """Ray forks processes; in a callback of a fork, Python would print the interrupt and go on."""
    from perilune_render.jobs import ray_actors

    done = []

    def init(*_, **__):
        os.kill(os.getpid(), signal.SIGINT)
        done.append("started")

    monkeypatch.setattr(ray_actors.ray, "init", init)
    monkeypatch.setattr(ray_actors.ray, "shutdown", lambda: done.append("ended"))
    with pytest.raises(KeyboardInterrupt), ray_actors.RayActors(job, open_store(tmp_path), 1, None):
        pass
    assert done == ["started", "ended"]


@pytest.mark.slow
def test_a_process_that_is_lost_while_it_generates_the_first_scene_is_replaced(job, tmp_path):
    import ray

    from perilune_render.jobs.ray_actors import RayActors

    class Loses(RayActors):
        lost = False

        def _start(self, n_actors):
            super()._start(n_actors)
            if not self.lost:
                self.lost = True
                ray.kill(self._actors[0].handle)

    with Loses(job, open_store(tmp_path), n_workers=1, address=None) as actors:
        actors.check_scene("scene-0000")
        assert actors.lost and [actor.scene_id for actor in actors._actors] == ["scene-0000"]


@pytest.mark.slow
def test_a_lost_node_is_replaced_by_one_that_joins(job, whole, files_of, tmp_path, capsys):
    from benchmarks.ray_cluster import LocalCluster
    from perilune_render.jobs.ray_actors import RayActors

    class LosesNode(Progress):
        """Kills the only node and adds another when the first trajectory is finished."""

        n_killed = 0

        def advance(self, task_id, advance=1):
            super().advance(task_id, advance)
            if advance and not self.n_killed:
                self.n_killed = cluster.kill(0)
                cluster.add()

    with LocalCluster(1) as cluster:
        two_threads = job.with_threads(2, 1)
        refused = pytest.raises(UserError, match="machines with 0 and 1 cores, expected a machine with 2")
        with refused, RayActors(two_threads, open_store(tmp_path), n_workers=None, address=cluster.address):
            pass
        progress = LosesNode(disable=True)
        render_job(job, tmp_path, progress, partial(RayActors, n_workers=1, address=cluster.address))
    # The node's raylet and agent, and the process that renders.
    assert progress.n_killed >= 2 and "a process of Ray was lost" in capsys.readouterr().err
    assert files_of(tmp_path) == whole
