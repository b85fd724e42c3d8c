"""The files that a store lists."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError


@dataclass(frozen=True, slots=True)
class Item:
    """One file of a store, as listed."""

    path: str
    """Path relative to the store."""
    size_bytes: int
    """Size, bytes."""


def local_items(folder: Path, prefix: str) -> Iterator[Item]:
    """Yield the files below a folder in the order of their paths; links are not followed.

    Files and folders that another process deletes meanwhile are omitted.
    """
    try:
        with os.scandir(folder) as scanned:
            # "a-b" comes before "a/b", as in the listing of an object store. Entries of millions of files would fill
            # memory, so only their names are kept.
            names = sorted(entry.name + ("/" if entry.is_dir(follow_symlinks=False) else "") for entry in scanned)
    except FileNotFoundError:
        return
    for name in names:
        if name.endswith("/"):
            yield from local_items(folder / name[:-1], prefix + name)
            continue
        try:
            size_bytes = os.lstat(f"{folder}/{name}").st_size
        except FileNotFoundError:
            continue
        yield Item(prefix + name, size_bytes)


def object_items(objects: Mapping[str, Any], prefix: str, address: str) -> Iterator[Item]:
    """Yield the objects that fsspec found below a prefix, in the order of their paths.

    Raises UserError about `address` if the store lists a key elsewhere, or an invalid size.
    """
    for key in sorted(objects):
        path = key.lstrip("/")
        if not path.startswith(f"{prefix}/"):
            if path == prefix:
                continue
            raise UserError(address, "list", repr(key), "only keys below this address")
        path = path[len(prefix) + 1 :]
        # A console may have made an empty object for a folder.
        if path and not path.endswith("/"):
            yield Item(path, checked_size(objects[key].get("size"), f"{address}: {path}"))


def checked_size(size: object, where: str) -> int:
    """Return the size of an object as the store states it. Raises UserError if it is not a number of bytes."""
    if isinstance(size, bool) or not isinstance(size, int) or not 0 <= size < 2**53:
        raise UserError(where, "size", repr(size), "the size of an object, bytes")
    return size
