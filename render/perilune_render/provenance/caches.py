"""Cache folders, for files that can be computed again."""

import functools
import os
import shutil
import stat
import tempfile
from pathlib import Path

import platformdirs

from perilune_render.provenance.fingerprint import compiled_functions, fingerprint

_KEPT = 5
"""Number of machine code folders kept, one for each version of the kernels."""


def cache_home() -> Path:
    """perilune's folder in the user's cache folder; for a user without a home folder, one in the temporary folder.

    Other users may write to the temporary folder, and numba executes the files it reads. If the folder there is not
    owned by the user or is accessible to others, a new folder with a random name is used.
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
    """The folder of machine code for the current kernels, in NUMBA_CACHE_DIR if that is set, else in `cache_home()`.

    Removes the least recently used folders. If the folder cannot be written, a temporary one is used.
    """
    parent = Path(os.environ.get("NUMBA_CACHE_DIR") or cache_home() / "kernels")
    folder = parent / f"perilune-{fingerprint(*compiled_functions()).sha256[:16]}"
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
