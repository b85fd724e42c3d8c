"""Cache folders for files that can be computed again."""

import contextlib
import functools
import hashlib
import json
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import platformdirs
from filelock import FileLock, Timeout

from perilune_render.provenance.fingerprint import FOLDERS, Fingerprint, compiled_functions, fingerprint
from perilune_shared.storage.files import write_text

_KEPT = 5
"""Number of machine code folders to keep, one for each version of the compiled functions."""
_LONGEST_WAIT_S = 120.0
"""Longest wait for another process that compiles a function; after it, this process compiles the function too."""


def cache_home() -> Path:
    """perilune's folder in the user's cache folder; without a home folder, in the temporary folder.

    Other users may write to the temporary folder, and numba executes the files that it reads. If perilune's folder in
    the temporary folder is not owned by the user or is accessible to others, a new folder with a random name is used.
    """
    if Path(os.environ.get("XDG_CACHE_HOME", "")).is_absolute() or _has_home():
        return platformdirs.user_cache_path("perilune")
    folder = Path(tempfile.gettempdir()) / f"perilune-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
        if stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="perilune-"))


def _has_home() -> bool:
    try:
        return Path.home().is_dir()
    except RuntimeError:  # no HOME and no entry in the password database, as in containers
        return False


@functools.cache
def machine_code_folder() -> Path:
    """The cache folder of the machine code for the current versions of the compiled functions.

    The folder is in NUMBA_CACHE_DIR if this variable is set, else in `cache_home()`. Removes all but the _KEPT most
    recently used folders. If the folder cannot be written, a temporary folder is used.
    """
    parent = _kernels()
    folder = parent / f"perilune-{_kept('compiled', lambda: fingerprint(*compiled_functions())).sha256[:16]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        known = sorted(parent.glob("perilune-*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for old in known[_KEPT:]:
            shutil.rmtree(old, ignore_errors=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="perilune-"))


@contextlib.contextmanager
def compiling(path: Path) -> Iterator[None]:
    """Hold the lock file of a compiled function while the block runs.

    The block runs without the lock if the file system has no locks, or after waiting _LONGEST_WAIT_S for another
    process.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError, NotImplementedError, Timeout):
            stack.enter_context(FileLock(path).acquire(timeout=_LONGEST_WAIT_S, poll_interval=0.02))
        yield


def kept_fingerprint(*roots: str) -> Fingerprint:
    """`fingerprint` of functions of perilune, stored in a file.

    Computing a fingerprint parses most source files, which takes 0.1 s.
    """
    return _kept(" ".join(roots), lambda: fingerprint(*roots))


def _kernels() -> Path:
    return Path(os.environ.get("NUMBA_CACHE_DIR") or cache_home() / "kernels")


def _kept(name: str, compute: Callable[[], Fingerprint]) -> Fingerprint:
    """A fingerprint from the file of this installation; if it is not in the file, compute and store it.

    The file is valid for one state of the sources. If the file is damaged or cannot be written, the fingerprint is
    computed.
    """
    folders_key = hashlib.sha256(repr(sorted(FOLDERS.items())).encode()).hexdigest()[:16]
    path, state = _kernels() / f"hashes-{folders_key}.json", _state_of_sources()
    stored: dict[str, dict] = {}
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["state"] == state:
            stored = dict(content["fingerprints"])
            value = stored[name]
            return Fingerprint(str(value["sha256"]), frozenset(value["modules"]), frozenset(value["libraries"]))
    computed = compute()
    plain = {"modules": sorted(computed.modules), "libraries": sorted(computed.libraries)}
    content = {"state": state, "fingerprints": {**stored, name: {"sha256": computed.sha256, **plain}}}
    with contextlib.suppress(OSError):
        write_text(path, json.dumps(content), durable=False)
    return computed


def _state_of_sources() -> str:
    """Hash of the version of Python and of the path, size, times and inode of every source file.

    Users cannot set the time of an inode's last change. This time therefore reveals a file that was replaced by a file
    of equal size and modification time.
    """
    states = [sys.version]
    for root in FOLDERS.values():
        for path in root.rglob("*.py"):
            state = path.stat()
            states.append(f"{path} {state.st_size} {state.st_mtime_ns} {state.st_ctime_ns} {state.st_ino}")
    return hashlib.sha256("\n".join(sorted(states)).encode()).hexdigest()
