"""Render a job in worker processes on this machine.

The pools of `concurrent.futures` and loky are not used for two reasons: a killed worker breaks the pool with all its
tasks, and the pools cannot give a task to the worker that already holds its scene.
"""

import tempfile
from multiprocessing.connection import Connection, wait
from typing import Any

import psutil

from perilune_render.jobs.job import Job
from perilune_render.jobs.report import Report
from perilune_render.jobs.work_list import N_ATTEMPTS, WorkList
from perilune_render.jobs.worker import Worker, start_worker
from perilune_render.terrain.grid import graded_grid
from perilune_shared.cgroups import memory_left_bytes
from perilune_shared.console.progress import say
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store, open_store
from perilune_shared.threads import usable_cores

RECYCLED_AFTER = 64
"""Number of trajectories after which a worker is replaced, so that its memory cannot grow without limit."""
LOST_STARTS = 3
"""Number of consecutive workers, per requested worker, that may end before they are ready."""
_BASE_BYTES, _VERTEX_BYTES = 0.75 * 2**30, 500
"""Peak memory of a worker: a constant part and a part per vertex, bytes.

Measured: 1.1 GiB for 1.2 million vertices, 3.1 GiB for 5.7 million.
"""
_GROUND_BYTES, _GROWING_BYTES = 16, 70
"""Memory per vertex outside the rendered mesh, and per vertex while ground is generated, bytes."""


class LocalWorkers:
    """Executor that renders in `n_workers` processes.

    The workers end with the block, or with this process. `early` is a worker that was started before; it is ignored if
    it has ended.
    """

    def __init__(self, job: Job, out: Store, n_workers: int, early: Worker | None = None):
        self._job, self._out, self._n_workers = job, for_other_processes(out), n_workers
        self._workers: dict[Connection, Worker] = {}
        if early is not None and early.process.poll() is None:
            self._workers[early.connection] = early
        self._lost_starts = 0
        self._scratch = tempfile.TemporaryDirectory(prefix="perilune-", ignore_cleanup_errors=True)

    def __enter__(self) -> "LocalWorkers":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for worker in list(self._workers.values()):
            self._end(worker, at_once=kind is not None or not worker.ready)
        self._scratch.cleanup()

    def check_scene(self, scene_id: str) -> None:
        """Generate a scene in a worker and check its poses (`check_poses`). Raises UserError if a check fails."""
        asked: list[Worker] = []
        while True:
            self._start(min(self._n_workers, len(self._job.plan.trajectories)) or 1)
            ready = [worker for worker in self._workers.values() if worker.ready]
            if ready and (not asked or asked[-1].connection not in self._workers):
                if len(asked) == N_ATTEMPTS:
                    expected = "a scene that can be generated: see the machine's free memory"
                    raise UserError(self._job.where, scene_id, asked[-1].how_ended, expected)
                asked.append(ready[0])
                ready[0].send("grow", scene_id)
            for worker in self._wait_for_messages():
                message = self._receive(worker)
                if message is not None and message[0] == "grown":
                    worker.scene_id = scene_id
                    for line in message[1]:
                        say(line)
                    return

    def render(self, work: WorkList, report: Report) -> None:
        """Render all trajectories of a work list.

        Raises only errors that would stop every trajectory, such as a full disk. Any other error
        is recorded in the work list as a failed attempt.
        """
        while True:
            n_busy = sum(worker.trajectory is not None for worker in self._workers.values())
            if not n_busy and not work.n_waiting:
                return
            self._start(min(self._n_workers, n_busy + work.n_waiting))
            for worker in list(self._workers.values()):
                if worker.ready and worker.trajectory is None:
                    self._hand_out(worker, work, report)
            for worker in self._wait_for_messages():
                self._handle(worker, self._receive(worker), work, report)

    def _hand_out(self, worker: Worker, work: WorkList, report: Report) -> None:
        index = work.take(worker.scene_id)
        if index is not None:
            worker.trajectory, worker.scene_id = index, self._job.plan.trajectories[index].scene_id
            worker.send("render", index)
            report.started(index)

    def _handle(self, worker: Worker, message: tuple | None, work: WorkList, report: Report) -> None:
        index = worker.trajectory
        match message:
            case ("note", text):
                report.note(text)
            case ("frame",) if index is not None:
                report.frame(index)
            case ("done", dark) if index is not None:
                work.done(index)
                report.done(index, dark)
                worker.trajectory, worker.n_done = None, worker.n_done + 1
                if worker.n_done >= RECYCLED_AFTER:
                    self._end(worker)
            case None | ("failed", _) if index is not None:
                error = worker.how_ended if message is None else message[1]
                report.failed(index, error, work.failed(index, error))
                self._end(worker)

    def _wait_for_messages(self) -> list[Worker]:
        """Workers that have sent a message or ended; waits for at least one."""
        ready = wait(self._workers)
        return [worker for connection, worker in self._workers.items() if connection in ready]

    def _receive(self, worker: Worker) -> tuple[Any, ...] | None:
        """The next message of a worker; None if the worker has ended and was removed.

        Raises the error with which a worker stops the run.
        """
        try:
            message = worker.connection.recv()
            if message == ("started",):
                worker.connection.send((self._job, self._out))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            self._end(worker)
            self._lost_starts += not worker.ready
            if self._lost_starts > LOST_STARTS * self._n_workers:
                expected = "a worker that starts: see the messages above, and the machine's free memory"
                raise UserError("perilune-render", "worker", worker.how_ended, expected) from None
            return None
        if message == ("ready",):
            worker.ready, self._lost_starts = True, 0
        elif message[0] == "stop":
            raise message[1]
        return message

    def _start(self, n_workers: int) -> None:
        """Start workers until there are `n_workers`."""
        while len(self._workers) < n_workers:
            taken = {worker.number for worker in self._workers.values()}
            number = next(number for number in range(n_workers) if number not in taken)
            worker = start_worker(self._scratch.name, self._job.config.render.engine, number)
            self._workers[worker.connection] = worker

    def _end(self, worker: Worker, *, at_once: bool = False) -> None:
        self._workers.pop(worker.connection, None)
        worker.end(at_once=at_once)


def for_other_processes(out: Store) -> Store:
    """The store `out` with an address that processes in other working directories can open.

    Raises UserError if it is in the memory of this process.
    """
    if out.address.startswith("memory://"):
        raise UserError(out, "--out", "memory of this process", "--workers 0, or an address that workers can open")
    return out if out.folder is None else open_store(out.folder.absolute())


def default_workers(job: Job, n_threads: int | None) -> int:
    """The default number of workers on this machine: one for each core, or one for each `n_threads` cores.

    There are no more workers than trajectories, and no more than fit in free memory. On two cores, two processes with
    one thread each rendered 1.28 times as many frames per second as one process with two threads
    (docs/notebook/2026-11-22-cores.md). More cores were not measured.
    """
    n_cores = usable_cores() // (n_threads or job.config.render.threads or 1)
    n_ground = graded_grid(job.config.terrain, job.plan.view).n_vertices
    n_vertices = min(n_ground, job.config.terrain.max_vertices)
    rendering = _VERTEX_BYTES * n_vertices + _GROUND_BYTES * (n_ground - n_vertices)
    fitting = int(_free_bytes() // (_BASE_BYTES + max(rendering, _GROWING_BYTES * n_ground)))
    return max(min(n_cores, len(job.plan.trajectories), fitting), 1)


def _free_bytes() -> float:
    """Memory that new processes may use, bytes: free memory, limited by the container or batch job."""
    free, left = float(psutil.virtual_memory().available), memory_left_bytes()
    return free if left is None else min(free, left)
