"""Threads of the numerical libraries: usable cores, settings of a program, work of other processes.

A thread of OpenMP, the runtime of torch's operations, spins while it waits for others. Where threads share cores with
other work, a spinning thread keeps a core from the one that it waits for. Programs of perilune therefore call
`set_up_program`, which limits spinning.

The libraries read environment variables when they are loaded, so a program calls it before importing torch, NumPy,
OpenCV or numba. Importing perilune changes no environment: a program of your own sets `GOMP_SPINCOUNT` itself, or calls
`set_up_program`. `warn_if_crowded` tells it so.

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
"""Rounds for which a waiting thread of libgomp spins before it sleeps, and on a machine with more work than cores.

libgomp's default is about 300,000. Chosen by measurement (docs/notebook/2026-11-27-speed.md): with less than 30,000
training is slower on idle cores, and beside a busy process it is fastest with 1000 or less.
"""
NUMBERS_OF_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Variables for the number of threads of OpenMP (torch), OpenBLAS (NumPy, SciPy), MKL and OpenCV."""
_MOST_THREADS = 1024
_PATTERNS = {
    **dict.fromkeys(
        (*NUMBERS_OF_THREADS, "NUMBA_NUM_THREADS"), (r"\d+", f"a number of threads from 1 to {_MOST_THREADS}")
    ),
    "OMP_NUM_THREADS": (r"\d+(\s*,\s*\d+)*", f"a number of threads from 1 to {_MOST_THREADS}"),
    "GOMP_SPINCOUNT": (r"\d+\s*[kKmMgGtT]?|INFINITE|INFINITY", "a number of rounds, or INFINITY"),
    "OMP_WAIT_POLICY": (r"ACTIVE|PASSIVE", "ACTIVE or PASSIVE"),
}
"""For each variable a pattern of its values and their description."""
_SPINNING = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
_STATISTICS = Path("/proc/stat")
_set_here: set[str] = set()
"""Variables that `set_up_program` has set, in this process."""
_warned = False


def cores_in_affinity() -> int:
    """Number of cores to which the scheduler may assign this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usable_cores() -> int:
    """Number of cores that this process may use, at least 1.

    It is limited by the process's affinity and by the processor quota of its container or batch job (Linux cgroups,
    versions 1 and 2); a quota of 1.5 cores counts as 2. A cgroup that cannot be read sets no limit.
    """
    quota = processor_quota()
    return cores_in_affinity() if quota is None else max(1, min(cores_in_affinity(), math.ceil(quota)))


def set_up_program() -> None:
    """Set the threads of the numerical libraries for this program and for the processes that it starts.

    Limits how long idle threads of OpenMP spin, and the number of threads to the quota of a container, which the
    libraries do not read. Values that the user has set stay. Call it before these libraries are imported.
    Raises UserError if the user has set a variable to a value that the libraries do not understand.
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
    _set_here.add(name)


def _check() -> None:
    for name, (pattern, expected) in _PATTERNS.items():
        value = os.environ.get(name, "").strip()
        numbers = [int(number) for number in re.findall(r"\d+", value)] if name.endswith(("THREADS", "NUM")) else []
        out_of_range = not all(1 <= number <= _MOST_THREADS for number in numbers)
        if value and (out_of_range or not re.fullmatch(pattern, value, re.IGNORECASE)):
            raise UserError("environment", name, value, expected)


def _load() -> float:
    """Mean number of processes that have run or waited for a core in the last minute."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def chosen_by_user(name: str) -> bool:
    """Whether an environment variable has a value that `set_up_program` has not set."""
    return name in os.environ and name not in _set_here


def described_settings() -> str:
    """One line on the usable cores and on the variables of threads, which says what the user has set."""
    names = [name for name in dict.fromkeys((*_SPINNING, *_PATTERNS)) if name in os.environ]
    values = [f"{name}={os.environ[name]}{' (from the environment)' if chosen_by_user(name) else ''}" for name in names]
    quota = processor_quota()
    limit = "" if quota is None else f" (quota of {quota:g} cores)"
    return f"threads: {usable_cores()} of {os.cpu_count() or 1} cores{limit}; {', '.join(values)}"


def warn_if_crowded() -> None:
    """Warn once in this process if the machine has more work than cores and idle OpenMP threads spin for long.

    For functions that a program of the user calls; commands have limited the spinning.
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
    """Processor time that other processes take from the cores of this one (Linux; elsewhere always 0).

    Example: `others = OtherWork()`, and later `others.cores()` for the mean since the last call.
    """

    def __init__(self) -> None:
        self._seconds, self._process_s, self._children_s = self._read()

    def cores(self) -> float:
        """Mean number of cores that other processes have used since the last call, or since the start."""
        before, process_before, children_before = self._seconds, self._process_s, self._children_s
        self._seconds, self._process_s, self._children_s = self._read()
        elapsed_s, busy_s = (now - then for now, then in zip(self._seconds, before, strict=True))
        own_s = self._process_s - process_before + self._children_s - children_before
        return max(0.0, (busy_s - own_s) / (elapsed_s / cores_in_affinity())) if elapsed_s > 0 else 0.0

    def _read(self) -> tuple[tuple[float, float], float, float]:
        """Seconds of all usable cores (elapsed and busy), of this process, and of its ended children."""
        times = os.times()
        return _core_seconds(), times.user + times.system, times.children_user + times.children_system


def _core_seconds() -> tuple[float, float]:
    """Seconds that have passed on the cores of this process's affinity, and seconds in which they were busy."""
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
