"""Write files and folders atomically (temporary name, then rename), and check relative paths."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from perilune_shared.console.interrupts import unfinished
from perilune_shared.errors import UserError
from perilune_shared.storage.locks import lock

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
_LONGEST_PATH = 500
_CHUNK_BYTES = 2**20
_FICLONE = 0x40049409
"""FICLONE from linux/fs.h. On PowerPC, MIPS and SPARC the number differs, so the call fails and files are copied."""


def temporary_name(path: Path) -> Path:
    """Return a unique temporary path in the folder of `path`, with the suffix of `path`."""
    # Use random digits, since process ids are not unique across containers.
    return path.with_name(f".{path.stem}.{secrets.token_hex(8)}.part{path.suffix}")


@contextlib.contextmanager
def written_aside(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` on success, remove it on any failure.

    The temporary name keeps the suffix of `path`, since image writers choose their format by the suffix. With `durable`
    the file is synchronised to disk before the rename, so that a power failure leaves no empty file. Callers that write
    many files pass durable=False and synchronise all of them at the end (`sync_all`).
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = temporary_name(path)
    with unfinished(aside):
        try:
            yield aside
            if durable:
                sync(aside)
            aside.replace(path)
            if durable:
                sync(path.parent)
        finally:
            aside.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Synchronise a file's content, or a folder's entries, to disk."""
    if os.name == "nt":  # Windows cannot open folders, nor synchronise files opened read-only
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # EINVAL: the file system does not support it
            raise
    finally:
        os.close(descriptor)


def sync_all(paths: Iterable[Path]) -> None:
    """Synchronise files and the entries of their folders to disk."""
    paths = list(paths)
    for path in [*paths, *sorted({path.parent for path in paths})]:
        sync(path)


def write_bytes(path: Path, content: bytes, *, durable: bool = True) -> None:
    """Write a file atomically."""
    with written_aside(path, durable=durable) as aside:
        aside.write_bytes(content)


def write_text(path: Path, content: str, *, durable: bool = True) -> None:
    """Write a UTF-8 text file atomically."""
    write_bytes(path, content.encode(), durable=durable)


def sha256_of(path: Path, advance: Callable[[int], object] = lambda n_bytes: None) -> str:
    """Return the SHA-256 of a file (hexadecimal).

    Calls `advance` with the number of bytes read since the last call.
    """
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
            advance(len(chunk))
    return digest.hexdigest()


def is_plain(relative: object) -> bool:
    """Whether `relative` is a relative POSIX path of plain names (letters, digits, ".", "_" and "-").

    Does not check links.
    """
    short = isinstance(relative, str) and len(relative) <= _LONGEST_PATH
    parts = PurePosixPath(str(relative)).parts if short else ()
    return bool(parts) and all(_PLAIN_NAME.fullmatch(part) for part in parts)


def inside(root: Path, relative: str) -> Path:
    """Return the path of `relative`, a POSIX path from a manifest, below `root`.

    Raises UserError if the path is absolute or too long, contains ".." or an invalid name, or leaves `root` through a
    link.
    """
    if not is_plain(relative):
        raise UserError(root, "path", repr(relative), "a relative POSIX path of plain names inside the dataset")
    parts = PurePosixPath(relative).parts
    path = root.joinpath(*parts)
    if not _has_link(root, parts):  # much faster than resolving the path
        return path
    try:
        is_inside = _without_links(path).is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # cyclic links
        is_inside = False
    if not is_inside:
        raise UserError(root, "path", repr(relative), "a path without links that leave the dataset")
    return path


def _has_link(root: Path, parts: Iterable[str]) -> bool:
    """Whether the existing part of a path below `root` contains a link."""
    path = os.fspath(root)
    for part in parts:
        path = f"{path}{os.sep}{part}"
        try:
            if stat.S_ISLNK(os.lstat(path).st_mode):
                return True
        except (FileNotFoundError, NotADirectoryError):
            return False
    return False


def _without_links(path: Path) -> Path:
    """Resolve a path that need not exist. Raises OSError or RuntimeError on cyclic links.

    From Python 3.13 on, `Path.resolve` detects cyclic links only with `strict`, which also makes missing files an
    error.
    """
    try:
        return path.resolve(strict=True)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise
        return path.resolve()


def check_plain_file(path: Path) -> int:
    """Return the size of a regular file, bytes.

    Raises UserError if the file is missing, a link, a folder, a pipe or a device; opening a pipe may block.
    """
    try:
        state = path.lstat()
    except (OSError, ValueError):
        raise UserError(path, "file", "no such file", "a regular file") from None
    if not stat.S_ISREG(state.st_mode):
        found = "a link" if stat.S_ISLNK(state.st_mode) else "a folder, a pipe or a device"
        raise UserError(path, "file", found, "a regular file")
    return state.st_size


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `out`; rename it to `out` on success, remove it on any failure.

    Files are synchronised to disk before the rename. If an earlier process was killed while it wrote to the same `out`,
    its hidden folder is removed. Raises UserError if `out` is not empty or another process is writing to it.
    """
    check_free(out)
    out = out.absolute()  # "." has no name from which to form a temporary name
    out.parent.mkdir(parents=True, exist_ok=True)
    with lock(out.with_name(f".{out.name}.lock"), out):
        leftover = re.compile(rf"\.{re.escape(out.name)}\.[0-9a-f]+\.part")
        for path in out.parent.iterdir():
            if leftover.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
        aside = out.with_name(f".{out.name}.{secrets.token_hex(8)}.part")
        with unfinished(aside):
            try:
                aside.mkdir()
                yield aside
                sync_all(path for path in aside.rglob("*") if not path.is_symlink())
                check_free(out)
                if out.is_dir():
                    out.rmdir()
                aside.replace(out)
                sync(out.parent)
            finally:
                shutil.rmtree(aside, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raise UserError if the folder for a new dataset is not empty."""
    if out.is_symlink() or (out.exists() and (not out.is_dir() or any(out.iterdir()))):
        raise UserError(out, "--out", "a path that is not empty", "a new or empty folder")


def copy_or_link(path: Path, to: Path, *, link: bool) -> None:
    """Copy a frame's file to `to`; with `link`, make a hard link if the file system allows it.

    Copies are reflinks (copy-on-write) where the file system supports them. Raises UserError if the file is missing.
    """
    if not path.is_file():
        raise UserError(path, "frame", "no such file", "the file listed in the manifest")
    to.parent.mkdir(parents=True, exist_ok=True)
    if link:
        with contextlib.suppress(OSError):
            # Link to the resolved file: a symbolic link might not lead to it from the new folder.
            os.link(path.resolve(), to)
            return
    if not _cloned(path, to):
        shutil.copyfile(path, to)


def _cloned(path: Path, to: Path) -> bool:
    """Try to make `to` a reflink of `path` (Btrfs, XFS and others on Linux); return whether it succeeded."""
    if not sys.platform.startswith("linux"):
        return False
    import fcntl

    with path.open("rb") as source, to.open("wb") as target:
        try:
            fcntl.ioctl(target.fileno(), _FICLONE, source.fileno())
        except OSError:
            return False
    return True
