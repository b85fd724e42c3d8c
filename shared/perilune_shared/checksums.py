"""SHA256SUMS: the hash of every file of a dataset but its frames, whose hashes stand in the manifest.

The file has the form of `sha256sum`, so that `sha256sum -c SHA256SUMS` checks it too.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from perilune_shared import files
from perilune_shared.errors import UserError

SUMS_NAME = "SHA256SUMS"
_LARGEST_BYTES = 20_000_000
_LARGEST_FILE = 2**36
_LINE = re.compile(r"([0-9a-f]{64})  (\S+)")
_OWN_FOLDERS = ("manifest", "images")


def seal(root: Path) -> None:
    """Write SHA256SUMS of all that lies in the dataset now, but links and odd names, which are faults."""
    names = [name for name in _covered(root) if files.is_plain(name) and not (root / name).is_symlink()]
    lines = [f"{files.sha256_of(root / name)}  {name}\n" for name in names]
    files.write_text(root / SUMS_NAME, "".join(lines))


def faults_of(root: Path) -> Iterator[tuple[str, str, str]]:
    """File, what was found and what was wanted, for all that differs from SHA256SUMS."""
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
        yield SUMS_NAME, "a line of another form", "64 hexadecimal digits, two blanks, a path"
        return
    listed = {line[2]: line[1] for line in lines if line is not None}
    if list(listed) != sorted(listed) or len(listed) != len(lines):
        yield SUMS_NAME, "paths twice or out of order", "each path once, in order"
    present = set(_covered(root))
    for name, sha256 in listed.items():
        try:
            file = files.inside(root, name)
        except UserError as error:
            yield SUMS_NAME, error.found, error.wanted
            continue
        if not file.is_file():
            yield name, "no such file", f"the file with SHA-256 {sha256}, as {SUMS_NAME} has it"
        elif file.stat().st_size > _LARGEST_FILE:
            yield name, f"{file.stat().st_size} bytes", f"at most {_LARGEST_FILE}"
        elif files.sha256_of(file) != sha256:
            yield name, "another content", f"SHA-256 {sha256}, as {SUMS_NAME} has it"
    for name in sorted(present - set(listed)):
        if name.split("/")[0] in (*_OWN_FOLDERS, "dataset.json"):
            yield name, "not listed in SHA256SUMS", "only files that the dataset was written with"


def _covered(root: Path) -> list[str]:
    """Files of the dataset's own folder, manifest/ and images/, sorted; hidden ones are work in progress."""
    found = [path for path in root.iterdir() if path.is_file() and path.name != SUMS_NAME]
    for folder in _OWN_FOLDERS:
        found += [path for path in root.joinpath(folder).rglob("*") if path.is_file() or path.is_symlink()]
    return sorted(p.relative_to(root).as_posix() for p in found if not p.name.startswith("."))
