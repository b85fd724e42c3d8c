"""Replace a folder that an earlier run of a command wrote: the option `--overwrite`."""

import contextlib
import ctypes
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from perilune_shared.console.interrupts import interrupts_held, unfinished
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import lock
from perilune_shared.storage.store import open_store

Out = TypeVar("Out", str, Path)
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
"""Constants from linux/fcntl.h and linux/fs.h."""


@contextlib.contextmanager
def replaceable(
    out: Out, known_by: tuple[str, ...], *, overwrite: bool, inputs: tuple[str | Path, ...] = ()
) -> Iterator[Out]:
    """Yield the path to which a command should write: `out`, or a new folder that will replace `out`.

    With `overwrite`, the new folder replaces `out` at the end of the block. The old folder stays until the new folder
    is complete, so an interrupted command leaves one of the two. `known_by` has patterns of files that the command
    always writes. The folder is replaced only if each pattern matches a file in it, so that a wrong `out` deletes no
    other data. `inputs` are the paths or addresses that the command reads.

    Without `overwrite`, raises UserError if the folder is not empty. With `overwrite`, raises UserError if a pattern
    has no match, if the folder contains an input or the current folder, or if `out` is in an object store.
    """
    folder = open_store(out).folder
    if overwrite and folder is None:
        raise UserError(out, "--overwrite", "an address", "a local folder; delete what is below the address first")
    if folder is None or not folder.is_dir() or not any(folder.iterdir()):
        yield out
        return
    if not overwrite:
        raise UserError(out, "--out", "a path that is not empty", "a new or empty folder; --overwrite replaces it")
    _check_replaceable(folder, out, known_by, inputs)
    folder = folder.absolute()
    with lock(folder.with_name(f".{folder.name}.lock"), folder):
        leftover = re.compile(rf"\.{re.escape(folder.name)}\.[0-9a-f]+\.(new|old)")
        for path in folder.parent.iterdir():
            if leftover.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
        new = folder.with_name(f".{folder.name}.{secrets.token_hex(8)}.new")
        with unfinished(new):
            try:
                yield type(out)(new)
                if new.exists():
                    _replace(folder, new)
            finally:
                shutil.rmtree(new, ignore_errors=True)


def _check_replaceable(
    folder: Path, out: str | Path, known_by: tuple[str, ...], inputs: tuple[str | Path, ...]
) -> None:
    if folder.is_symlink() or not all(any(folder.glob(pattern)) for pattern in known_by):
        expected = "a folder that this command wrote, with " + " and ".join(known_by)
        raise UserError(out, "--overwrite", "another folder", expected)
    resolved = folder.resolve()
    if Path.cwd().is_relative_to(resolved):
        raise UserError(out, "--overwrite", "the current folder or a parent of it", "another folder")
    for read in inputs:
        source = open_store(read).folder
        if source is not None and source.resolve().is_relative_to(resolved):
            raise UserError(out, "--overwrite", f"a folder that contains the input {read}", "another folder")


def _replace(folder: Path, new: Path) -> None:
    """Replace `folder` by the folder `new`, and delete the old content."""
    with interrupts_held():
        if not _exchanged(folder, new):
            old = new.with_suffix(".old")
            folder.rename(old)
            try:
                new.rename(folder)
            except OSError:
                old.rename(folder)
                raise
            new = old
    shutil.rmtree(new, ignore_errors=True)


def _exchanged(folder: Path, other: Path) -> bool:
    """Try to exchange two folders atomically; return whether it succeeded.

    A killed process then leaves both folders intact. Only Linux supports this, and not on all file systems.
    """
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None) if os.name == "posix" else None
    names = os.fsencode(folder), os.fsencode(other)
    return (
        renameat2 is not None
        and renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], ctypes.c_uint(_RENAME_EXCHANGE)) == 0
    )
