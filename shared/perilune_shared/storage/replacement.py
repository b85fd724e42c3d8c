"""Replace a folder that an earlier run of a command wrote: the option `--overwrite`."""

import contextlib
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from perilune_shared.errors import UserError
from perilune_shared.storage.store import open_store

Out = TypeVar("Out", str, Path)


@contextlib.contextmanager
def replaceable(out: Out, known_by: tuple[str, ...], *, overwrite: bool) -> Iterator[Out]:
    """Yield the folder to write: `out`, or with `overwrite` a new folder that replaces `out` when the block ends.

    The old folder stays until the new one is complete. It is replaced only if it has one of the files or folders
    `known_by`, which the command always writes, so that a wrong `out` deletes no other data. Raises UserError if it
    has none of them, if it is not empty and `overwrite` is false, or with `overwrite` if `out` is in an object store.
    """
    folder = open_store(out).folder
    if overwrite and folder is None:
        raise UserError(out, "--overwrite", "an address", "a local folder; delete what is below the address first")
    if folder is None or not folder.is_dir() or not any(folder.iterdir()):
        yield out
        return
    if not overwrite:
        raise UserError(out, "--out", "a path that is not empty", "a new or empty folder; --overwrite replaces it")
    if folder.is_symlink() or not any(folder.joinpath(name).exists() for name in known_by):
        expected = "a folder that this command has written, with " + " or ".join(known_by)
        raise UserError(out, "--overwrite", "another folder", expected)
    if Path.cwd().is_relative_to(folder.resolve()):
        raise UserError(out, "--overwrite", "the current folder, or a parent of it", "another folder")
    folder = folder.absolute()
    made = folder.with_name(f".{folder.name}.{secrets.token_hex(8)}.new")
    old = made.with_suffix(".old")
    try:
        yield type(out)(made)
        if not made.exists():
            return
        folder.rename(old)
        try:
            made.rename(folder)
        except OSError:
            old.rename(folder)
            raise
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(made, ignore_errors=True)
