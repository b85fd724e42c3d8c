"""SHA256SUMS: the hashes of all files of a dataset except frame files, whose hashes are in the manifest.

The file has the format of `sha256sum`; check it with `sha256sum -c SHA256SUMS`.
"""

import contextlib
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_shared.progress import NO_PROGRESS, Progress
from perilune_shared.storage import files

SUMS_NAME = "SHA256SUMS"
_LARGEST_BYTES = 20_000_000
_LARGEST_FILE = 2**36
_LINE = re.compile(r"([0-9a-f]{64})  (\S+)")
_OWN_FOLDERS = ("manifest", "shards")


def seal(root: Path, progress: Progress = NO_PROGRESS, known: Mapping[str, str] | None = None) -> None:
    """Write SHA256SUMS for all files of the dataset, except links and invalid names, which are faults.

    `known` contains hashes computed earlier in this run; these files are not read again.
    """
    names = [name for name in _covered(root) if files.is_plain(name) and not (root / name).is_symlink()]
    hashes = dict(known or {})
    with _hashing(root, [name for name in names if name not in hashes], progress) as advance:
        for name in names:
            if name not in hashes:
                hashes[name] = files.sha256_of(root / name, advance)
    files.write_text(root / SUMS_NAME, "".join(f"{hashes[name]}  {name}\n" for name in names))


def sums_of(root: Path) -> dict[str, str]:
    """Read the SHA-256 of each file in SHA256SUMS; the dataset must have no faults (`faults_of`)."""
    lines = [_LINE.fullmatch(line) for line in (root / SUMS_NAME).read_text(encoding="utf-8").splitlines()]
    return {line[2]: line[1] for line in lines if line is not None}


def faults_of(root: Path, progress: Progress = NO_PROGRESS) -> Iterator[tuple[str, str, str]]:
    """Yield file, value found and value expected for each difference from SHA256SUMS."""
    path = root / SUMS_NAME
    if not path.is_file() or path.is_symlink():
        yield SUMS_NAME, "no such file", "the hashes of the dataset's files"
        return
    if path.stat().st_size > _LARGEST_BYTES:
        yield SUMS_NAME, f"{path.stat().st_size} bytes", f"at most {_LARGEST_BYTES}"
        return
    text = path.read_bytes().decode("utf-8", errors="replace")
    lines = [_LINE.fullmatch(line) for line in text.removesuffix("\n").split("\n")]
    if not text.endswith("\n") or None in lines:
        yield SUMS_NAME, "an invalid line", "64 hexadecimal digits, two spaces, a path"
        return
    listed = {line[2]: line[1] for line in lines if line is not None}
    if list(listed) != sorted(listed) or len(listed) != len(lines):
        yield SUMS_NAME, "repeated or unsorted paths", "each path once, sorted"
    present = set(_covered(root))
    with _hashing(root, [name for name in listed if name in present], progress) as advance:
        for name, sha256 in listed.items():
            try:
                file = files.inside(root, name)
            except UserError as error:
                yield SUMS_NAME, error.found, error.expected
                continue
            if not file.is_file():
                yield name, "no such file", f"the file with SHA-256 {sha256}, as in {SUMS_NAME}"
            elif file.stat().st_size > _LARGEST_FILE:
                yield name, f"{file.stat().st_size} bytes", f"at most {_LARGEST_FILE}"
            elif files.sha256_of(file, advance) != sha256:
                yield name, "a different SHA-256", f"SHA-256 {sha256}, as in {SUMS_NAME}"
    for name in sorted(present - set(listed)):
        yield name, "not listed in SHA256SUMS", "only the dataset's files"


@contextlib.contextmanager
def _hashing(root: Path, names: list[str], progress: Progress) -> Iterator[Callable[[int], object]]:
    """Yield a function that advances the progress bar by a number of bytes read."""
    total = sum((root / name).stat().st_size for name in names if (root / name).is_file())
    task = progress.add_task("hashing", total=total / 1e6, unit="MB")
    yield lambda n_bytes: progress.advance(task, n_bytes / 1e6)
    progress.update(task, completed=total / 1e6)


def _covered(root: Path) -> list[str]:
    """List the files directly in the dataset's folder and below manifest/ and shards/, sorted, without hidden files."""
    found = [path for path in root.iterdir() if path.is_file() and path.name != SUMS_NAME]
    for folder in _OWN_FOLDERS:
        found += [path for path in root.joinpath(folder).rglob("*") if path.is_file() or path.is_symlink()]
    return sorted(p.relative_to(root).as_posix() for p in found if not p.name.startswith("."))
