"""Render a job with Ray, on this machine or on a cluster. Each process of Ray is an actor with one renderer.

Ray places the actors on machines. When a process or a machine is lost, this module starts a new actor. A `WorkList`
hands out trajectories as for local workers, so that an actor rarely changes its scene.
"""

import logging
import os
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import RayActorError, RayTaskError

from perilune_render.jobs.job import Job
from perilune_render.jobs.local import LOST_STARTS, RECYCLED_AFTER, for_other_processes
from perilune_render.jobs.report import Report
from perilune_render.jobs.scene_renderer import SceneRenderer
from perilune_render.jobs.work_list import WorkList
from perilune_render.jobs.worker import ONE_THREAD
from perilune_render.provenance.processor import SETTINGS
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.console.progress import say
from perilune_shared.errors import UserError, ends_run
from perilune_shared.storage.store import Store


class _Renderer:
    """The actor class: it holds a scene renderer in a process of Ray."""

    def start(self, job: Job, out: Store) -> None:
        """Receive the job. Raises UserError if this process has other code or libraries than the job's recipe."""
        self._renderer = SceneRenderer(job, out)

    def grow(self, scene_id: str) -> list[str]:
        """Generate a scene and check its poses; returns warnings."""
        return self._renderer.check(scene_id)

    def render(self, index: int) -> list[str]:
        """Render a trajectory; returns the ids of its dark frames."""
        return self._renderer.render(index, lambda: None, lambda text: None)


@dataclass(slots=True, eq=False)
class _Actor:
    """The driver's record of an actor."""

    handle: Any
    """Ray's handle of the actor."""
    ready: bool = False
    """Whether the actor is running."""
    trajectory: int | None = None
    """Index of the trajectory that the actor is rendering."""
    scene_id: str | None = None
    """Id of the scene that the actor keeps."""
    n_done: int = 0
    """Number of trajectories that the actor has rendered."""


class RayActors:
    """Executor that renders with Ray in `n_workers` actors, by default as many as the cluster's cores allow.

    Each actor has the configured number of threads, or one thread if the configured number is 0. Ray reserves a core
    for each thread. `address` is the address of a running cluster; None starts Ray on this machine for the duration of
    the block. If `out` is a folder, all machines must have it at the same path.
    """

    def __init__(self, job: Job, out: Store, n_workers: int | None, address: str | None):
        self._address, self._out, self._n_workers = address, for_other_processes(out), n_workers
        self._n_threads = job.config.render.threads or 1
        self._job = job.with_threads(self._n_threads, 1)
        self._actors: list[_Actor] = []
        self._pending: dict[Any, _Actor] = {}
        self._lost_starts = 0

    def __enter__(self) -> "RayActors":
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        local = {"num_cpus": self._n_workers * self._n_threads} if self._n_workers and self._address is None else {}
        try:
            with interrupts_held():  # Ray forks, and Python ignores interrupts in fork callbacks
                ray.init(
                    self._address or "local",
                    include_dashboard=None if self._address else False,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    **local,
                )
        except KeyboardInterrupt:
            ray.shutdown()
            raise
        except ConnectionError as error:
            raise UserError("--address", "", error, "the address of a running Ray cluster, as host:6379") from None
        n_cores = sorted(int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"])
        n_fitting = sum(each // self._n_threads for each in n_cores)
        if not n_fitting:
            ray.shutdown()
            expected = f"a machine with {self._n_threads} cores, one for each thread of a process (--threads)"
            raise UserError("--executor", "", f"machines with {' and '.join(map(str, n_cores))} cores", expected)
        self._n_workers = self._n_workers or n_fitting
        self._remote_job = ray.put(self._job)
        return self

    def __exit__(self, *_: object) -> None:
        with interrupts_held():  # an interrupted shutdown would leave processes behind
            ray.shutdown()

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene in an actor and check its poses (`check_poses`). Raises UserError if a check fails."""
        while True:
            self._start(1)
            actor = self._actors[0]
            try:
                warnings = ray.get([*self._pending, actor.handle.grow.remote(scene_id)])[-1]
            except RayActorError as error:
                self._pending.clear()
                self._lose_start(actor, error)
            except RayTaskError as error:
                raise error.cause from None
            else:
                actor.scene_id = scene_id
                for line in warnings:
                    say(line)
                return

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list.

        Raises only errors that would stop every trajectory, such as a full disk. Any other error
        is recorded in the work list as a failed attempt.
        """
        while True:
            busy = [actor for actor in self._actors if actor.trajectory is not None]
            if not busy and not work.n_waiting:
                return
            self._start(min(self._n_workers or 1, len(busy) + work.n_waiting))
            for actor in self._actors:
                if actor.ready and actor.trajectory is None:
                    self._hand_out(actor, work, report)
            (finished,), _ = ray.wait(list(self._pending), num_returns=1)
            self._handle(self._pending.pop(finished), finished, work, report)

    def _hand_out(self, actor: _Actor, work: WorkList, report: Report) -> None:
        index = work.take(actor.scene_id)
        if index is not None:
            actor.trajectory, actor.scene_id = index, self._job.plan.trajectories[index].scene_id
            self._pending[actor.handle.render.remote(index)] = actor
            report.started(index)
            report.note(actor.scene_id)

    def _handle(self, actor: _Actor, finished: Any, work: WorkList, report: Report) -> None:
        index = actor.trajectory
        try:
            dark = ray.get(finished)
        except RayActorError as error:
            if index is None:
                self._lose_start(actor, error)
                return
            self._actors.remove(actor)
            text = f"a process of Ray was lost ({type(error).__name__})"
            report.failed(index, text, work.failed(index, text))
            return
        except RayTaskError as error:
            if index is None or ends_run(error.cause):
                raise error.cause from None
            text = f"{type(error.cause).__name__}: {error.cause}"
            report.failed(index, text, work.failed(index, text))
            actor.trajectory = None
            return
        actor.ready, actor.trajectory, self._lost_starts = True, None, 0
        if index is not None:
            for _ in range(self._job.n_frames(index)):
                report.frame(index)
            work.done(index)
            report.done(index, dark)
            actor.n_done += 1
            if actor.n_done >= RECYCLED_AFTER:
                self._actors.remove(actor)
                ray.kill(actor.handle)

    def _lose_start(self, actor: _Actor, error: RayActorError) -> None:
        """Remove an actor that was lost before it rendered a trajectory.

        Raises UserError if too many actors were lost in succession.
        """
        self._actors.remove(actor)
        self._lost_starts += 1
        if self._lost_starts > LOST_STARTS * (self._n_workers or 1):
            raise UserError("perilune-render", "Ray", error, "processes that start: see Ray's logs") from None

    def _start(self, n_actors: int) -> None:
        """Start actors until there are `n_actors`; each gets work once it is running."""
        remote = ray.remote(
            num_cpus=self._n_threads,
            max_restarts=0,
            # Ray may import NumPy before perilune, and other machines do not inherit this process's environment.
            runtime_env={"env_vars": {**SETTINGS, **dict.fromkeys(ONE_THREAD, "1")}},
        )(_Renderer)
        while len(self._actors) < n_actors:
            actor = _Actor(remote.remote())
            self._actors.append(actor)
            self._pending[actor.handle.start.remote(self._remote_job, self._out)] = actor
