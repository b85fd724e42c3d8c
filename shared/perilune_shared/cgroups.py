"""Processor and memory limits of a container or batch job: Linux cgroups, versions 1 and 2."""

from collections.abc import Iterator
from pathlib import Path

_ROOT, _MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def processor_quota() -> float | None:
    """Return the smallest processor quota, in cores, of this process's cgroup and its parents.

    Returns None without a quota.
    """
    quotas = [quota / period for quota, period in _pairs("cpu") if quota > 0 and period > 0]
    return min(quotas, default=None)


def memory_left_bytes() -> float | None:
    """Return the memory, in bytes, that the limits of this process's cgroup and its parents still allow.

    Returns None without a limit.
    """
    left = [float(limit - used) for limit, used in _pairs("memory") if limit >= 0]
    return min(left, default=None)


_FILES = {
    "cpu": (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")),
    "memory": (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")),
}
"""Files with quota and period (cpu) or limit and usage (memory): cgroup version 2, then version 1."""


def _pairs(controller: str) -> Iterator[tuple[int, int]]:
    """Yield both numbers of each cgroup. Skips "max" (no limit) and files that cannot be read."""
    for folder in _folders(controller):
        for names in _FILES[controller]:
            try:
                first, second = " ".join((folder / name).read_text(encoding="ascii") for name in names).split()
                yield int(first), int(second)
            except (OSError, ValueError):
                continue


def _folders(controller: str) -> list[Path]:
    """Return the folders of this process's cgroups for a controller, up to the roots.

    In a container, the path in /proc/self/cgroup may be outside the mounted tree; the mounted root is then the
    container's own cgroup.
    """
    try:
        lines = _MEMBERSHIP.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    folders = [_ROOT, _ROOT / controller, _ROOT / "cpu,cpuacct"]
    for line in lines:
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        roots = (_ROOT / controllers, _ROOT / controller) if controllers else (_ROOT, _ROOT / "unified")
        inner = Path(path.lstrip("/"))
        folders += [root / part for root in roots for part in (inner, *inner.parents)]
    return list(dict.fromkeys(folders))
