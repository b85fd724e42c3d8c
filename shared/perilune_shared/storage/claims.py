"""Claim an address of an object store, so that only one run writes a whole dataset there.

An object store has no locks. A claim is an object that the process of the run renews. A claim is ignored if it was not
renewed for 60 seconds, or if its process ran on this machine and has ended.
"""

import contextlib
import json
import os
import platform
import secrets
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError
from perilune_shared.storage.store import Store

_RENEWAL_INTERVAL_S = 15.0
_EXPIRY_S = 60.0
_LARGEST_BYTES = 10_000


@contextlib.contextmanager
def claimed(store: Store, folder: str) -> Iterator[None]:
    """Hold a claim, a file below `folder` of a store, within the block.

    Raises UserError if another process holds a claim.
    """
    path = f"{folder}/{secrets.token_hex(8)}.json"
    claim = {"pid": os.getpid(), "host": platform.node(), "system": _system()}
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(_RENEWAL_INTERVAL_S):
            with contextlib.suppress(UserError, OSError):
                _write(store, path, claim)

    # Write the claim before reading others: if two runs start together, at least one sees the other.
    _write(store, path, claim)
    renewal = threading.Thread(target=renew, daemon=True, name=f"claim {store}")
    try:
        for item in [*store.list(folder)]:
            other = None if item.path == path else _read(store, item.path, item.size_bytes)
            if other is not None:
                _check_ended(store, other)
                store.delete(item.path)
        renewal.start()
        yield
    finally:
        ended.set()
        if renewal.ident is not None:
            renewal.join()
        # If the store does not answer, an earlier write has already raised an error.
        with contextlib.suppress(UserError, OSError):
            store.delete(path)


def _check_ended(store: Store, claim: dict[str, Any]) -> None:
    """Raise UserError unless the holder of a claim has ended."""
    left_s = _EXPIRY_S - (time.time() - claim["updated"])
    if left_s <= 0 or (claim["system"] == _system() and not _is_other_process(claim["pid"])):
        return
    found = f"written by PID {claim['pid']} on host {claim['host']}"
    raise UserError(store, "--out", found, f"another address; if that process was killed, wait {left_s:.0f} s")


def _write(store: Store, path: str, claim: dict[str, Any]) -> None:
    store.replace(path, json.dumps({**claim, "updated": time.time()}).encode())


def _read(store: Store, path: str, size_bytes: int) -> dict[str, Any] | None:
    """Return the content of a claim; None if the file was removed meanwhile or is damaged."""
    try:
        content = json.loads(store.read(path)) if size_bytes <= _LARGEST_BYTES else {}
        fields = (("pid", int), ("host", str), ("system", str), ("updated", float))
        return content if all(isinstance(content[name], kind) for name, kind in fields) else None
    except (UserError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _is_other_process(pid: int) -> bool:
    """Whether another running process has this id."""
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _system() -> str:
    """Return an id of the process namespace (machine or container), within which process ids are unique."""
    with contextlib.suppress(OSError):
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot_id} {Path('/proc/self/ns/pid').readlink()}"
    return platform.node()
