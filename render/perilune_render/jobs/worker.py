"""A worker process: renders the trajectories that its parent sends, one at a time (`local.py`).

`start_worker` starts `python -m perilune_render.jobs.worker DESCRIPTOR PARENT SCRATCH ENGINE`: the descriptor of its
end of the connection, the parent's process id, a folder for temporary files, which the parent removes, and the engine
to load before the job arrives. The parent's part of this module imports quickly: a command can
start a worker before it loads other libraries.
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

WORKER = ("-m", "perilune_render.jobs.worker")
"""Arguments of Python that start a worker process."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables set to 1 in a worker: the number of threads of linear algebra changes the last digits of results."""
_END_S = 5.0
"""Longest time for a worker to end by itself, seconds."""
_PR_SET_PDEATHSIG = 1
"""PR_SET_PDEATHSIG from linux/prctl.h."""


@dataclass(slots=True)
class Worker:
    """A worker process, as its parent sees it."""

    process: subprocess.Popen
    connection: Connection
    ready: bool = False
    """Whether it has received the job."""
    trajectory: int | None = None
    """The trajectory that it renders."""
    scene_id: str | None = None
    """The scene that it keeps."""
    n_done: int = 0
    """Number of trajectories that it has rendered."""

    def send(self, command: str, target: object) -> None:
        """Send a command. Raises nothing if the worker has ended: receiving its messages shows that."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((command, target))

    @property
    def how_ended(self) -> str:
        """How the process ended."""
        code = self.process.wait()
        return f"worker killed by {signal.Signals(-code).name}" if code < 0 else f"worker ended with code {code}"

    def end(self, *, at_once: bool = False) -> None:
        """End the process; all that it reported as done is on the disk. Has no effect if it has already ended."""
        self.connection.close()
        if at_once:
            self.process.kill()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def start_worker(scratch: str, engine: str) -> Worker:
    """Start a worker, which writes its temporary files into the folder `scratch`."""
    ours, theirs = Pipe()
    arguments = [str(theirs.fileno()), str(os.getpid()), scratch, engine]
    with theirs:
        process = subprocess.Popen(
            # -P: a module in the current folder must not take the place of an installed one.
            [sys.executable, "-P", *WORKER, *arguments],
            pass_fds=[theirs.fileno()],
            env={**os.environ, **dict.fromkeys(ONE_THREAD, "1")},
            stdin=subprocess.DEVNULL,
            # Ctrl-C reaches only the parent, which then ends its workers.
            process_group=0,
        )
    return Worker(process, ours)


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
    """Serve the parent until it closes the connection or a trajectory fails; a failure needs a new worker."""
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
    """Let the kernel kill this process when its parent ends for any reason, even within native code."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


if __name__ == "__main__":
    main()
