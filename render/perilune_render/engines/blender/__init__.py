"""Rendering with Blender: the only folder that imports bpy."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Restrict this process to one core while the block runs (Linux).

    Blender sizes its pool of threads by the cores that it may use when it starts. Each thread of the pool without work
    spins while Cycles renders, so a rendering by one thread would occupy all cores. A pool for one core has no such
    threads; Cycles still starts the number of threads in its settings.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores, threads = os.sched_getaffinity(0), Path("/proc/self/task")
    before = set(threads.iterdir())
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
        for thread in set(threads.iterdir()) - before:
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread.name), cores)


with _one_core():
    import bpy  # noqa: F401
