"""Rendering with Blender. Only this folder imports bpy."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Restrict this process to one core while the block runs (Linux).

    When Blender starts, it creates a pool with one thread for each core that it may use. While Cycles renders, idle
    threads of this pool spin, so even a rendering by one thread would occupy all cores. A pool for one core has no idle
    threads. Cycles still starts the number of threads in its settings.
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
