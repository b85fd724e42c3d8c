"""A worker process: renders the trajectories that its parent sends, one at a time (`local.py`).

Started as `python -m perilune_render.jobs.worker DESCRIPTOR PARENT SCRATCH`: the descriptor of its end of the
connection, the parent's process id, and a folder for temporary files, which the parent removes.
"""

import contextlib
import ctypes
import os
import signal
import sys
import tempfile
from multiprocessing.connection import Connection

from perilune_render.jobs.scene_renderer import SceneRenderer
from perilune_shared.errors import ends_run

_PR_SET_PDEATHSIG = 1
"""PR_SET_PDEATHSIG from linux/prctl.h."""


def main() -> None:
    """Serve the parent until it closes the connection, or a trajectory fails: the next worker starts afresh."""
    _end_with(int(sys.argv[2]))
    tempfile.tempdir = sys.argv[3]
    connection = Connection(int(sys.argv[1]))
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            _serve(connection)
        except Exception as error:
            if not ends_run(error):
                raise
            connection.send(("stop", error))


def _serve(connection: Connection) -> None:
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
