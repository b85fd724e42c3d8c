"""Files written aside and renamed, and relative paths that cannot leave their folder."""

import contextlib
import hashlib
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from perilune_shared.errors import UserError

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
_LONGEST_PATH = 500


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`; rename it to `path` on success, remove it on any failure.

    The temporary name keeps the suffix of `path`, since image writers choose their format by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield aside
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file, or nothing."""
    with written_aside(path) as aside:
        aside.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write a whole UTF-8 file, or nothing."""
    write_bytes(path, content.encode())


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's content, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def is_plain(relative: object) -> bool:
    """Whether it is a relative POSIX path of plain names, without regard to links."""
    short = isinstance(relative, str) and len(relative) <= _LONGEST_PATH
    parts = PurePosixPath(str(relative)).parts if short else ()
    return bool(parts) and all(_PLAIN_NAME.fullmatch(part) for part in parts)


def inside(root: Path, relative: str) -> Path:
    """The file that a manifest's relative POSIX path names below `root`.

    Raises UserError where the path is absolute, climbs, has an odd name, is too long or leaves `root` through a link.
    """
    if not is_plain(relative):
        raise UserError(root, "path", repr(relative), "a relative POSIX path of plain names inside the dataset")
    path = root.joinpath(*PurePosixPath(relative).parts)
    try:
        own = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError):  # links that lead to themselves
        own = False
    if not own:
        raise UserError(root, "path", repr(relative), "a path that no link leads out of the dataset")
    return path


def check_plain_file(path: Path) -> int:
    """The size of a file, bytes. Raises UserError where it is none: opening a pipe or a device may never end."""
    try:
        state = path.lstat()
    except (OSError, ValueError):
        raise UserError(path, "file", "no such file", "a file of the dataset's own") from None
    if not stat.S_ISREG(state.st_mode):
        found = "a link" if stat.S_ISLNK(state.st_mode) else "a folder, a pipe or a device"
        raise UserError(path, "file", found, "a file of the dataset's own")
    return state.st_size


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A hidden folder beside `out`, renamed to `out` on success and removed on any failure.

    Raises UserError where `out` holds something.
    """
    check_free(out)
    out = out.absolute()  # "." has no name to put another beside
    aside = out.with_name(f".{out.name}.{os.getpid()}.part")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        yield aside
        if out.is_dir():
            out.rmdir()
        aside.replace(out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raises UserError where a folder for a new dataset holds something."""
    if out.is_symlink() or (out.exists() and (not out.is_dir() or any(out.iterdir()))):
        raise UserError(out, "--out", "something that is there", "a new or empty folder")


def bring(path: Path, to: Path, *, link: bool) -> None:
    """Make a frame's file present at `to` too: linked where asked for and the disk allows it, else copied.

    Raises UserError where it is missing.
    """
    if not path.is_file():
        raise UserError(path, "frame", "no such file", "the file that the manifest names")
    to.parent.mkdir(parents=True, exist_ok=True)
    if link:
        with contextlib.suppress(OSError):
            # A link to a link would lead to what need not be here.
            os.link(path.resolve(), to)
            return
    shutil.copyfile(path, to)
