"""Run one command on hostile input, in a process of its own; measure its memory and time, and check how it ends."""

import contextlib
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

MEASURED = "PERILUNE_HOSTILE_LOG"
"""Variable with the file to which each measured input adds a line; `conftest.py` prints their summary."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    name: str
    """The input."""
    code: int
    """Exit code; negative for a signal."""
    output: str
    """Standard output and standard error."""
    memory_mb: float
    """Resident memory at its peak beyond what the process had at its start, MB."""
    seconds: float
    """Wall time."""

    @property
    def error(self) -> str:
        """The last line that begins with `error: `, or nothing."""
        lines = [line for line in self.output.splitlines() if line.startswith("error: ")]
        return lines[-1] if lines else ""


def outcome(
    name: str, main: Callable[[], object], *arguments: object, folder: Path | None = None, limit_s: float = 60.0
) -> Outcome:
    """Fork this process and run the entry point `main` of a command line with these arguments, in `folder`.

    `main` must be imported before, so that its imports count neither as memory nor as time. Fails if the command runs
    longer than `limit_s`.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    read, write = os.pipe()
    read_before, write_before = os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(read)
        # After a fork less is resident than in the parent: pages of files are mapped again when they are used.
        os.write(write_before, str(_resident_mb()).encode())
        os.close(write_before)
        _run(main, [str(argument) for argument in arguments], folder, write)
    os.close(write)
    os.close(write_before)
    before_mb = float(os.read(read_before, 100) or 0)
    os.close(read_before)
    text, late = bytearray(), False
    while True:
        left = started + limit_s - time.monotonic()
        if not select.select([read], [], [], max(left, 0))[0]:
            late = True
            os.kill(child, signal.SIGKILL)
            break
        part = os.read(read, 1 << 16)
        if not part:
            break
        text += part
    os.close(read)
    _, status, usage = os.wait4(child, 0)
    seconds = time.monotonic() - started
    measured = Outcome(
        name,
        os.waitstatus_to_exitcode(status),
        text.decode(errors="replace"),
        max(0.0, usage.ru_maxrss / 1024 - before_mb),
        seconds,
    )
    assert not late, f"{name}: still runs after {limit_s:g} s\n{measured.output[-2000:]}"
    if MEASURED in os.environ:
        with Path(os.environ[MEASURED]).open("a", encoding="utf-8") as log:
            log.write(json.dumps(asdict(measured) | {"output": ""}) + "\n")
    return measured


def refused(
    name: str,
    main: Callable[[], object],
    *arguments: object,
    naming: str,
    folder: Path | None = None,
    memory_mb: float = 500.0,
    limit_s: float = 60.0,
) -> Outcome:
    """Run a command that must refuse its input: one line that holds `naming`, exit code 2, bounded memory and time."""
    ended = outcome(name, main, *arguments, folder=folder, limit_s=limit_s)
    assert ended.code == 2, f"{name}: exit code {ended.code}\n{ended.output[-2000:]}"
    assert "Traceback" not in ended.output, ended.output[-3000:]
    assert naming in ended.error, f"{name}: {ended.output[-2000:]}"
    assert all(sign.isprintable() or sign in "\n\r\x1b" for sign in ended.output), repr(ended.output[-2000:])
    assert ended.memory_mb <= memory_mb, f"{name}: {ended.memory_mb:.0f} MB\n{ended.output[-2000:]}"
    return ended


def accepted(
    name: str,
    main: Callable[[], object],
    *arguments: object,
    folder: Path | None = None,
    memory_mb: float = 500.0,
    limit_s: float = 60.0,
) -> Outcome:
    """Run a command that must do its work within these limits."""
    ended = outcome(name, main, *arguments, folder=folder, limit_s=limit_s)
    assert ended.code == 0, f"{name}: exit code {ended.code}\n{ended.output[-2000:]}"
    assert ended.memory_mb <= memory_mb, f"{name}: {ended.memory_mb:.0f} MB\n{ended.output[-2000:]}"
    return ended


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def _run(main: Callable[[], object], arguments: list[str], folder: Path | None, write: int) -> None:
    """Be the child: run the command and end the process with its exit code."""
    code = 1
    try:
        os.dup2(write, 1)
        os.dup2(write, 2)
        # pytest's capture has replaced both.
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        os.environ["COLUMNS"] = "2000"
        if folder is not None:
            os.chdir(folder)
        sys.argv = ["command", *arguments]
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except BaseException:
            import traceback

            traceback.print_exc()
    finally:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
