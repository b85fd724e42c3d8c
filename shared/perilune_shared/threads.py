"""Set the threads of the numerical libraries; measure usable cores and the load of other processes.

torch computes with OpenMP threads. A thread that waits for another thread spins, which occupies a core. If other
programs use the cores too, the awaited thread may then have no core. Programs of perilune therefore call
`set_up_program`, which limits spinning.

The libraries read environment variables when they are loaded, so a program must call `set_up_program` before it imports
torch, NumPy, OpenCV or numba. Importing perilune changes no environment variable. A program that imports perilune
should therefore call `set_up_program` itself or set `GOMP_SPINCOUNT`; otherwise `warn_if_crowded` may warn.

Example:

    from perilune_shared.threads import set_up_program

    set_up_program()
    import torch
"""

import math
import os
import re
import warnings
from pathlib import Path

from perilune_shared.cgroups import processor_quota
from perilune_shared.errors import UserError

SPIN_COUNT, CROWDED_SPIN_COUNT = 30_000, 1000
"""Rounds that a waiting libgomp thread spins before it sleeps: usual, and on an overloaded machine.

libgomp's default is about 300,000. The values were chosen by measurement (docs/notebook/2026-11-27-speed.md). On idle
cores, training is slower below 30,000 rounds. Beside a busy process, training is fastest with 1000 rounds or less.
"""
NUMBERS_OF_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Environment variables that set the threads of OpenMP (torch), OpenBLAS (NumPy, SciPy), MKL, OpenCV."""
WORKER_NUMBER = "PERILUNE_WORKER"
"""Environment variable with the number of a worker process, from 0."""
_MAX_THREADS = 1024
_PATTERNS = {
    **dict.fromkeys(
        (*NUMBERS_OF_THREADS, "NUMBA_NUM_THREADS"), (r"\d+", f"a number of threads from 1 to {_MAX_THREADS}")
    ),
    "OMP_NUM_THREADS": (r"\d+(\s*,\s*\d+)*", f"a number of threads from 1 to {_MAX_THREADS}"),
    "GOMP_SPINCOUNT": (r"\d+\s*[kKmMgGtT]?|INFINITE|INFINITY", "a number of rounds, or INFINITY"),
    "OMP_WAIT_POLICY": (r"ACTIVE|PASSIVE", "ACTIVE or PASSIVE"),
}
"""Pattern and description of the valid values of each variable."""
_SPINNING = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
_STATISTICS = Path("/proc/stat")
_set_by_program: set[str] = set()
"""Variables that `set_up_program` has set in this process."""
_warned = False


def cores_in_affinity() -> int:
    """Number of cores to which the scheduler may assign this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_cores() -> int:
    """Number of cores that this process may use, at least 1.

    The number is limited by the affinity of the process and by the processor quota of the container or batch job (Linux
    cgroups, versions 1 and 2). A quota of 1.5 cores counts as 2. A cgroup that cannot be read sets no limit.
    """
    quota = processor_quota()
    return cores_in_affinity() if quota is None else max(1, min(cores_in_affinity(), math.ceil(quota)))


def worker_number() -> int:
    """Number of this worker process on its machine, from 0; 0 in a process that is no worker."""
    value = os.environ.get(WORKER_NUMBER, "0")
    if not value.isdecimal():
        raise UserError("environment", WORKER_NUMBER, value, "the number of a worker process, from 0")
    return int(value)


def set_up_program() -> None:
    """Set the threads of the numerical libraries for this program and for the processes that it starts.

    Limits how long idle OpenMP threads spin. Limits the number of threads to the quota of the container, which the
    libraries do not read. Values set by the user are kept. Call this function before the libraries are imported. Raises
    UserError if the user has set a variable to a value that the libraries do not understand.
    """
    _check()
    if not any(name in os.environ for name in _SPINNING):
        _set("GOMP_SPINCOUNT", CROWDED_SPIN_COUNT if _load() > cores_in_affinity() else SPIN_COUNT)
    if usable_cores() < cores_in_affinity():
        for name in NUMBERS_OF_THREADS:
            if name not in os.environ:
                _set(name, usable_cores())


def _set(name: str, value: int) -> None:
    os.environ[name] = str(value)
    _set_by_program.add(name)


def _check() -> None:
    for name, (pattern, expected) in _PATTERNS.items():
        value = os.environ.get(name, "").strip()
        numbers = [int(number) for number in re.findall(r"\d+", value)] if name.endswith(("THREADS", "NUM")) else []
        out_of_range = not all(1 <= number <= _MAX_THREADS for number in numbers)
        if value and (out_of_range or not re.fullmatch(pattern, value, re.IGNORECASE)):
            raise UserError("environment", name, value, expected)


def _load() -> float:
    """Return the mean number of processes that ran or waited for a core in the last minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def chosen_by_user(name: str) -> bool:
    """Whether an environment variable is set, but not by `set_up_program`."""
    return name in os.environ and name not in _set_by_program


def described_settings() -> str:
    """Return one line with the usable cores and the thread variables; values set by the user are marked."""
    names = [name for name in dict.fromkeys((*_SPINNING, *_PATTERNS)) if name in os.environ]
    values = [f"{name}={os.environ[name]}{' (from the environment)' if chosen_by_user(name) else ''}" for name in names]
    quota = processor_quota()
    limit = "" if quota is None else f" (quota of {quota:g} cores)"
    return f"threads: {usable_cores()} of {os.cpu_count() or 1} cores{limit}; {', '.join(values)}"


def warn_if_crowded() -> None:
    """Warn once per process if the machine has more work than cores and OpenMP threads spin for long.

    Called by functions that users call in their own programs. perilune's commands limit the spinning themselves.
    """
    global _warned
    if _warned or any(name in os.environ for name in _SPINNING):
        return
    load = _load()
    if load > cores_in_affinity():
        _warned = True
        warnings.warn(
            f"the load is {load:.1f} on {cores_in_affinity()} cores, and waiting OpenMP threads spin: "
            f"set GOMP_SPINCOUNT={CROWDED_SPIN_COUNT} before Python starts, "
            "or call perilune_shared.threads.set_up_program() before importing torch",
            RuntimeWarning,
            stacklevel=3,
        )


class OtherWork:
    """Measures how many of the cores of this process other processes use (Linux; elsewhere always 0).

    Example: `others = OtherWork()`; later, `others.cores()` returns the mean since the last call.
    """

    def __init__(self) -> None:
        self._seconds, self._process_s, self._children_s = self._read()

    def cores(self) -> float:
        """Return the mean number of cores that other processes used since the last call, or since creation."""
        before, process_before, children_before = self._seconds, self._process_s, self._children_s
        self._seconds, self._process_s, self._children_s = self._read()
        elapsed_s, busy_s = (now - then for now, then in zip(self._seconds, before, strict=True))
        own_s = self._process_s - process_before + self._children_s - children_before
        return max(0.0, (busy_s - own_s) / (elapsed_s / cores_in_affinity())) if elapsed_s > 0 else 0.0

    def _read(self) -> tuple[tuple[float, float], float, float]:
        """Return seconds: of all usable cores (elapsed, busy), of this process and of its ended children."""
        times = os.times()
        return _core_seconds(), times.user + times.system, times.children_user + times.children_system


def _core_seconds() -> tuple[float, float]:
    """Return elapsed and busy seconds, summed over the cores of this process's affinity."""
    try:
        lines = _STATISTICS.read_text(encoding="ascii", errors="replace").splitlines()
        cores = os.sched_getaffinity(0)
        ticks_per_s = os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError):
        return 0.0, 0.0
    elapsed = busy = 0
    for line in lines:
        name, *ticks = line.split()
        if name[:3] == "cpu" and name[3:].isdecimal() and int(name[3:]) in cores:
            # user nice system idle iowait irq softirq steal; guest times are part of user and nice.
            used = [int(tick) for tick in ticks[:8]]
            elapsed += sum(used)
            busy += sum(used) - sum(used[3:5])
    return elapsed / ticks_per_s, busy / ticks_per_s
