"""List the files of a folder or of an object store."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perilune_shared.errors import UserError


@dataclass(frozen=True, slots=True)
class Item:
    """A file in the listing of a store."""

    path: str
    """Path relative to the store."""
    size_bytes: int
    """Size, bytes."""


def local_items(folder: Path, prefix: str) -> Iterator[Item]:
    """Yield the files below a folder in the order of their paths; links are not followed.

    Files and folders that another process deletes during the listing are omitted.
    """
    try:
        with os.scandir(folder) as scanned:
            # With a slash, the folder "a" comes after the file "a-b", as in the listing of an object store. Keep only
            # names, since directory entries of millions of files would fill memory.
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

    Raises UserError, which names `address`, if the store lists a key outside the prefix or an invalid size.
    """
    for key in sorted(objects):
        path = key.lstrip("/")
        if not path.startswith(f"{prefix}/"):
            if path == prefix:
                continue
            raise UserError(address, "list", repr(key), "only keys below this address")
        path = path[len(prefix) + 1 :]
        # Skip the empty objects that some web consoles create for folders.
        if path and not path.endswith("/"):
            yield Item(path, checked_size(objects[key].get("size"), f"{address}: {path}"))


def checked_size(size: object, where: str) -> int:
    """Return `size`, which a store states for an object, in bytes.

    Raises UserError about `where` if it is not a valid size.
    """
    if isinstance(size, bool) or not isinstance(size, int) or not 0 <= size < 2**53:
        raise UserError(where, "size", repr(size), "the size of an object, bytes")
    return size
