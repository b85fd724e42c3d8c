"""The files that a store lists."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Item:
    """One file of a store, as listed."""

    path: str
    """Path relative to the store."""
    size_bytes: int
    """Size, bytes."""


def local_items(folder: Path, prefix: str) -> Iterator[Item]:
    """Yield the files below a folder in the order of their paths; links are not followed.

    Files and folders that another process deletes meanwhile are left out.
    """
    try:
        with os.scandir(folder) as scanned:
            # "a-b" comes before "a/b", as in the listing of an object store.
            found = sorted(scanned, key=lambda entry: entry.name + ("/" if entry.is_dir(follow_symlinks=False) else ""))
    except FileNotFoundError:
        return
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            yield from local_items(Path(entry.path), f"{prefix}{entry.name}/")
            continue
        try:
            size_bytes = entry.stat(follow_symlinks=False).st_size
        except FileNotFoundError:
            continue
        yield Item(prefix + entry.name, size_bytes)


def object_items(found: Mapping[str, Any], prefix: str) -> Iterator[Item]:
    """Yield the objects that fsspec found below a prefix, in the order of their paths."""
    start = len(prefix) + 1
    for key in sorted(found):
        path = key.lstrip("/")[start:]
        # A console may have made an empty object for a folder.
        if path and not path.endswith("/"):
            yield Item(path, int(found[key]["size"]))
