"""Record the conditions of a run or a benchmark: commit, hardware, command and date."""

import functools
import os
import platform
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from perilune_shared.threads import usable_cores

_CHECKOUT = Path(__file__).resolve().parents[2]
_MODEL, _BFLOAT16 = re.compile(r"^model name\s*:\s*(.+)$", re.MULTILINE), "avx512_bf16"


@dataclass(frozen=True, slots=True)
class RunRecord:
    """Commit, hardware, load, command and date of a run."""

    commit: str
    """Commit (40 digits), then " modified" if tracked files were changed; "unknown" outside a checkout."""
    hardware: str
    """Number of cores, processor, memory."""
    load: float
    """Load average over the minute before the program started; high if other programs were running."""
    command: str
    """The command line."""
    date: str
    """Start date, UTC, for example 2026-01-31."""


@functools.cache
def run_record() -> RunRecord:
    """Return the record of this process.

    The first call creates it, so call this function when the program starts.
    """
    return RunRecord(_commit(), _hardware(), round(_load(), 1), _command(), f"{datetime.now(UTC):%Y-%m-%d}")


def _commit() -> str:
    # An installed package may lie inside the repository of another project.
    if not (_CHECKOUT / ".git").exists():
        return "unknown"
    try:
        commit = _git("rev-parse", "HEAD")
        return f"{commit} modified" if _git("status", "--porcelain", "--untracked-files=no") else commit
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(_CHECKOUT), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def _hardware() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    model = _MODEL.search(text)
    name = model.group(1).strip() if model else platform.processor() or platform.machine()
    bfloat16 = ["AVX512-BF16"] if _BFLOAT16 in text else []
    return ", ".join([f"{_cores()} {name}", *bfloat16, *_memory()])


def _cores() -> str:
    every = os.cpu_count() or 1
    return f"{every} cores" if usable_cores() == every else f"{usable_cores()} of {every} cores"


def _memory() -> list[str]:
    try:
        return [f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.0f} GiB"]
    except (AttributeError, OSError, ValueError):
        return []


def _load() -> float:
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def _command() -> str:
    program = Path(sys.argv[0])
    if sys.orig_argv[1:2] == ["-m"]:
        name = f"python -m {sys.orig_argv[2]}"
    elif program.suffix == ".py":
        name = f"python {program.name}"
    else:
        name = program.name
    return shlex.join([*name.split(), *sys.argv[1:]])
