"""Lock an output folder, so that only one process writes to it.

The operating system manages the lock and releases it when the process ends for any reason. A record beside the lock
file names the process that holds the lock. Some network drives do not propagate locks between machines; there only the
record protects the folder. The holder renews the record, which expires ten minutes after the last renewal.
"""

import contextlib
import json
import os
import platform
import re
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from perilune_shared.console.interrupts import interrupts_held, unfinished
from perilune_shared.errors import UserError

LOCK_NAME = ".perilune.lock"
"""Lock file in a folder that is written in place."""
_RENEWAL_INTERVAL_S = 30.0
_EXPIRY_S = 600.0
_LARGEST_RECORD_BYTES = 10_000
TEMPORARY_FILE = re.compile(r"\..+\.[0-9a-f]+\.part(\.[A-Za-z0-9]+)?")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder that is written in place; remove temporary files of killed processes.

    Creates the folder and its parents if they do not exist, and removes them again if they stay empty. Raises UserError
    if another process holds the lock.
    """
    created = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with lock(folder / LOCK_NAME, folder):
            remove_temporary_files(folder)
            yield
    finally:
        with contextlib.suppress(OSError):
            for each in created:
                each.rmdir()


def remove_temporary_files(folder: Path) -> None:
    """Remove temporary files that killed processes left, at any depth.

    Call it only if no other process writes in the folder.
    """
    for root, _, names in os.walk(folder):
        for name in filter(TEMPORARY_FILE.fullmatch, names):
            Path(root, name).unlink(missing_ok=True)


@contextlib.contextmanager
def lock(path: Path, folder: Path) -> Iterator[None]:
    """Lock the file `path`, which protects `folder`. Raises UserError if another process holds the lock."""
    file_lock, record, held_elsewhere = FileLock(path), path.with_name(f"{path.name}.json"), False
    try:
        try:
            # An interrupt within `acquire` would leave the lock file behind.
            with interrupts_held():
                file_lock.acquire(timeout=0)
        except Timeout:
            raise _locked_error(folder, _read(record), "a free folder: wait until that process ends") from None
        seconds_left = _seconds_left(record)
        held_elsewhere = seconds_left > 0
        if held_elsewhere:
            expected = f"a free folder: if that process was killed, remove {record} or wait {seconds_left:.0f} s"
            raise _locked_error(folder, _read(record), expected)
        with unfinished(path, record), _recorded(record):
            yield
    finally:
        if file_lock.is_locked:
            # Remove the file before releasing the lock: after the release, it may be the lock of another process.
            if not held_elsewhere:
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)
            file_lock.release()


def _seconds_left(record: Path) -> float:
    """Return the seconds until the record of a process on another machine expires; 0 without a record.

    A record from this machine is ignored: since the lock was free, its process has ended.
    """
    holder = _read(record)
    if holder is None or holder.get("boot_id") == _boot_id():
        return 0.0
    return max(_EXPIRY_S - (time.time() - record.stat().st_mtime), 0.0)


@contextlib.contextmanager
def _recorded(record: Path) -> Iterator[None]:
    """Write a record with this process as the holder, and renew it regularly within the block."""
    since = datetime.now(UTC).isoformat(timespec="seconds")
    holder = {"pid": os.getpid(), "host": platform.node(), "since": since, "boot_id": _boot_id()}
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(_RENEWAL_INTERVAL_S):
            with contextlib.suppress(OSError):
                os.utime(record)

    try:
        record.write_text(json.dumps(holder) + "\n", encoding="utf-8")
        threading.Thread(target=renew, daemon=True, name=f"lock {record}").start()
        yield
    finally:
        ended.set()
        record.unlink(missing_ok=True)


def _read(record: Path) -> dict[str, Any] | None:
    """Read the record of the holder; None if there is no record."""
    try:
        if not record.is_file() or record.stat().st_size > _LARGEST_RECORD_BYTES:
            return None
        content = json.loads(record.read_bytes())
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def _locked_error(folder: Path, holder: dict[str, Any] | None, expected: str) -> UserError:
    known = holder or {}
    words = {"pid": "PID", "host": "on host", "since": "since"}
    text = " ".join(f"{word} {known[name]}" for name, word in words.items() if name in known)
    return UserError(folder, "folder", f"locked by {text or 'another process'}", expected)


def _boot_id() -> str:
    """Return an id of the running kernel.

    It is equal in all containers of a machine, and different after each boot.
    """
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return platform.node()
