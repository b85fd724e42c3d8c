"""A worker process, which renders the trajectories that its parent sends, one at a time (`local.py`).

`start_worker` starts `python -m perilune_render.jobs.worker DESCRIPTOR PARENT SCRATCH ENGINE`:

    DESCRIPTOR  file descriptor of the worker's end of the connection
    PARENT      process id of the parent
    SCRATCH     folder for temporary files, which the parent removes
    ENGINE      engine to load before the job arrives

This module imports no large library at the top, so that a command can start a worker before it loads other libraries.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe

from perilune_shared.errors import ends_run
from perilune_shared.threads import WORKER_NUMBER

WORKER = ("-m", "perilune_render.jobs.worker")
"""Arguments of Python that start a worker process."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables set to 1 in a worker.

The number of threads in linear algebra changes the last digits of its results.
"""
_END_S = 5.0
"""Time to wait for a worker to end before it is killed, seconds."""
_PR_SET_PDEATHSIG = 1
"""PR_SET_PDEATHSIG from linux/prctl.h."""


@dataclass(slots=True)
class Worker:
    """The parent's handle of a worker process."""

    process: subprocess.Popen
    connection: Connection
    ready: bool = False
    """Whether the worker has received the job."""
    trajectory: int | None = None
    """Index of the trajectory that the worker is rendering, if any."""
    scene_id: str | None = None
    """Id of the scene that the worker holds in memory, if any."""
    n_done: int = 0
    """Number of trajectories that the worker has rendered."""
    number: int = 0
    """Number among the workers that run at the same time, from 0; it selects the worker's GPU."""

    def send(self, command: str, target: object) -> None:
        """Send a command. An ended worker causes no error here, but when its next message is received."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((command, target))

    @property
    def how_ended(self) -> str:
        """A text that says how the process ended; waits for its end."""
        code = self.process.wait()
        return f"worker killed by {signal.Signals(-code).name}" if code < 0 else f"worker ended with code {code}"

    def end(self, *, at_once: bool = False) -> None:
        """End the process, if it is still running. Everything that it reported as done is on the disk."""
        self.connection.close()
        if at_once:
            self.process.kill()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def start_worker(scratch: str, engine: str, number: int = 0) -> Worker:
    """Start a worker that loads `engine` and writes its temporary files into the folder `scratch`.

    `number` is `Worker.number`.
    """
    ours, theirs = Pipe()
    arguments = [str(theirs.fileno()), str(os.getpid()), scratch, engine]
    with theirs:
        process = subprocess.Popen(
            # -P: a module in the current folder must not take the place of an installed one.
            [sys.executable, "-P", *WORKER, *arguments],
            pass_fds=[theirs.fileno()],
            env={**os.environ, **dict.fromkeys(ONE_THREAD, "1"), WORKER_NUMBER: str(number)},
            stdin=subprocess.DEVNULL,
            # Ctrl-C reaches only the parent, which then ends its workers.
            process_group=0,
        )
    return Worker(process, ours, number=number)


@contextlib.contextmanager
def early_worker(engine: str) -> Iterator[Worker]:
    """Yield a worker that loads its libraries while its parent plans the job; end it with the block."""
    with tempfile.TemporaryDirectory(prefix="perilune-", ignore_cleanup_errors=True) as scratch:
        worker = start_worker(scratch, engine)
        try:
            yield worker
        finally:
            worker.end(at_once=True)


def main() -> None:
    """Serve the parent until it closes the connection or a trajectory fails.

    After a failure the parent starts a new worker.
    """
    _end_with(int(sys.argv[2]))
    tempfile.tempdir = sys.argv[3]
    connection = Connection(int(sys.argv[1]))
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            _serve(connection, sys.argv[4])
        except Exception as error:
            if not ends_run(error):
                raise
            connection.send(("stop", error))


def _serve(connection: Connection, engine: str) -> None:
    from perilune_render.engines.open_engine import load_engine
    from perilune_render.jobs.scene_renderer import SceneRenderer

    load_engine(engine)
    connection.send(("started",))
    job, out = connection.recv()
    with SceneRenderer(job, out) as renderer:
        connection.send(("ready",))
        while True:
            command, target = connection.recv()
            if command == "grow":
                connection.send(("grown", renderer.check(target)))
                continue
            try:
                dark = renderer.render(
                    target, lambda: connection.send(("frame",)), lambda text: connection.send(("note", text))
                )
            except Exception as error:
                if ends_run(error):
                    raise
                connection.send(("failed", f"{type(error).__name__}: {error}"))
                return
            connection.send(("done", dark))


def _end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends for any reason, even while native code is running."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


if __name__ == "__main__":
    main()
