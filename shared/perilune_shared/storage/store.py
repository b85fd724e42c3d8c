"""Read and write the files of a dataset in a local folder or below a prefix of an object store.

Use:

    store = open_store("s3://bucket/moon")           # or a path, gs://bucket/prefix, memory://name
    store.write("frames/s000/t000/000000.png", png) # atomic
    store.read("dataset.json")

All paths are relative to the folder or prefix: POSIX paths of plain names. Every fault of an object store raises a
UserError that names the address.
"""

import abc
import errno
import functools
import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.items import Item, checked_size, local_items, object_items
from perilune_shared.storage.object_stores import OBJECT_STORES, file_system, is_missing_bucket, store_faults
from perilune_shared.storage.ranges import Ranges

_CHUNK_BYTES = 2**20
_KINDS = "a path, s3://bucket/prefix, gs://bucket/prefix or memory://name"


class Store(abc.ABC):
    """Base class for the files below one address; `open_store` returns an instance."""

    address: str
    """Folder or prefix as text, without a slash at the end."""
    folder: Path | None = None
    """The local folder; None for an object store."""

    @property
    def is_local(self) -> bool:
        """Whether the store is a local folder."""
        return self.folder is not None

    def at(self, path: str) -> str:
        """Return the address of one file, for messages."""
        return f"{self.address}/{path}"

    def __str__(self) -> str:
        return self.address

    def __repr__(self) -> str:
        return f"open_store({self.address!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Store) and self.address == other.address

    def __hash__(self) -> int:
        return hash(self.address)

    def exists(self, path: str) -> bool:
        """Whether a file exists."""
        return self.size(path) is not None

    def plain_size(self, path: str) -> int:
        """Return the size of a file, bytes.

        Raises UserError if it is missing, a link, a folder, a pipe or a device.
        """
        size = self.size(path)
        if size is None:
            raise _missing(self, path)
        return size

    def sha256(self, path: str, advance: Callable[[int], object] = lambda n_bytes: None) -> str:
        """Return the SHA-256 of a file (hexadecimal).

        Calls `advance` with the number of bytes read since the last call.
        """
        digest = hashlib.sha256()
        with self.open(path) as stream:
            while chunk := stream.read(_CHUNK_BYTES):
                digest.update(chunk)
                advance(len(chunk))
        return digest.hexdigest()

    @abc.abstractmethod
    def sub(self, prefix: str) -> "Store":
        """Return the store of the files below a prefix. Raises UserError if the prefix is not plain."""

    @abc.abstractmethod
    def list(self, prefix: str = "") -> Iterator[Item]:
        """Yield all files below a prefix, sorted by path; for a local folder also links, pipes and devices."""

    @abc.abstractmethod
    def size(self, path: str) -> int | None:
        """Return the size of a file, bytes; None if it is missing.

        Raises UserError if it is not a regular file.
        """

    @abc.abstractmethod
    def read(self, path: str, start: int = 0, end: int | None = None, *, most_bytes: int | None = None) -> bytes:
        """Return the bytes [start, end) of a file.

        Raises UserError if it is missing, or larger than `most_bytes`.
        """

    @abc.abstractmethod
    def open(self, path: str) -> BinaryIO:
        """Open a file for reading. Raises UserError if it is missing.

        From an object store, only the ranges that are read are fetched, in blocks of 4 MiB.
        """

    @abc.abstractmethod
    def write(self, path: str, content: bytes, *, durable: bool = True) -> None:
        """Write a new file atomically; an existing file with equal content stays unchanged.

        With `durable`, a local file is synchronised to disk. Raises FileExistsError if the file exists with other
        content.
        """

    @abc.abstractmethod
    def replace(self, path: str, content: bytes, *, durable: bool = True) -> None:
        """Write a file atomically; an existing file is replaced.

        With `durable`, a local file is synchronised to disk.
        """

    @abc.abstractmethod
    def sync(self, paths: Iterable[str]) -> None:
        """Synchronise local files that were written with durable=False to disk; does nothing for objects."""

    @abc.abstractmethod
    def delete(self, path: str) -> None:
        """Delete a file if it exists."""

    @abc.abstractmethod
    def delete_below(self, prefix: str) -> None:
        """Delete all files below a prefix."""


Address = str | os.PathLike[str] | Store
"""A local path, the address of a prefix of an object store, or an open store."""


class LocalStore(Store):
    """A local folder. Access to pipes, devices and links that leave the folder raises UserError."""

    folder: Path

    def __init__(self, folder: Path):
        self.folder = folder
        self.address = str(folder)

    def sub(self, prefix: str) -> "LocalStore":
        return LocalStore(files.inside(self.folder, prefix))

    def list(self, prefix: str = "") -> Iterator[Item]:
        top = files.inside(self.folder, prefix) if prefix else self.folder
        if top.is_dir():
            yield from local_items(top, f"{prefix}/" if prefix else "")

    def size(self, path: str) -> int | None:
        try:
            state = files.inside(self.folder, path).stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        if not stat.S_ISREG(state.st_mode):
            raise UserError(self.at(path), "file", "a folder, a pipe or a device", "a regular file")
        return state.st_size

    def plain_size(self, path: str) -> int:
        if not files.is_plain(path):
            files.inside(self.folder, path)
        size = files.check_plain_file(self.folder / path)
        files.inside(self.folder, path)
        return size

    def read(self, path: str, start: int = 0, end: int | None = None, *, most_bytes: int | None = None) -> bytes:
        size = self._plain_or_linked(path)
        if most_bytes is not None and size > most_bytes:
            raise _too_large(self, path, size, most_bytes)
        with (self.folder / path).open("rb") as stream:
            stream.seek(start)
            return stream.read() if end is None else stream.read(max(min(end, size) - start, 0))

    def open(self, path: str) -> BinaryIO:
        self._plain_or_linked(path)
        return (self.folder / path).open("rb")

    def _plain_or_linked(self, path: str) -> int:
        """Return the size of a regular file or of the file to which a link within the folder leads, bytes.

        Raises UserError if it is missing.
        """
        size = self.size(path)
        if size is None:
            raise _missing(self, path)
        return size

    def write(self, path: str, content: bytes, *, durable: bool = True) -> None:
        target = files.inside(self.folder, path)
        size = self.size(path)
        if size is None:
            files.write_bytes(target, content, durable=durable)
        elif size != len(content) or self.read(path) != content:
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), self.at(path))

    def replace(self, path: str, content: bytes, *, durable: bool = True) -> None:
        files.write_bytes(files.inside(self.folder, path), content, durable=durable)

    def sync(self, paths: Iterable[str]) -> None:
        files.sync_all(files.inside(self.folder, path) for path in paths)

    def delete(self, path: str) -> None:
        files.inside(self.folder, path).unlink(missing_ok=True)

    def delete_below(self, prefix: str) -> None:
        shutil.rmtree(files.inside(self.folder, prefix), ignore_errors=True)


class ObjectStore(Store):
    """A prefix of an object store, accessed through fsspec.

    The instance can be used in forked processes and in several threads.
    """

    def __init__(self, address: str):
        self.address = address
        self._kind, _, self._prefix = address.partition("://")
        self._opened: Any = None
        self._pid = -1

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None, "_pid": -1}

    @property
    def _system(self) -> Any:
        """fsspec's file system; opened again after a fork, since connections do not survive a fork."""
        if self._pid != os.getpid():
            self._opened, self._pid = file_system(self._kind, self.address), os.getpid()
        return self._opened

    def _key(self, path: str) -> str:
        if not files.is_plain(path):
            raise UserError(self.address, "path", repr(path), "a relative POSIX path of plain names inside the dataset")
        return f"{self._prefix}/{path}"

    def sub(self, prefix: str) -> "ObjectStore":
        self._key(prefix)
        return ObjectStore(self.at(prefix))

    def list(self, prefix: str = "") -> Iterator[Item]:
        top = self._key(prefix) if prefix else self._prefix
        objects: dict[str, Any] = {}
        with store_faults(self.address):
            try:
                objects = self._system.find(top, detail=True)
            except FileNotFoundError as error:
                if is_missing_bucket(error):
                    raise
        yield from object_items(objects, self._prefix, self.address)

    def size(self, path: str) -> int | None:
        with store_faults(self.at(path)):
            try:
                info = self._system.info(self._key(path))
            except FileNotFoundError:
                return None
        return checked_size(info.get("size"), self.at(path)) if info.get("type") == "file" else None

    def read(self, path: str, start: int = 0, end: int | None = None, *, most_bytes: int | None = None) -> bytes:
        if end is not None and end <= start:
            return b""
        if most_bytes is not None:
            end = min(most_bytes + 1, most_bytes + 1 if end is None else end)
        with store_faults(self.at(path)):
            try:
                content = self._system.cat_file(self._key(path), start=start or None, end=end)
            except FileNotFoundError as error:
                if is_missing_bucket(error):
                    raise
                raise _missing(self, path) from None
        if not isinstance(content, bytes):
            raise UserError(self.at(path), "content", type(content).__name__, "the bytes of the object")
        if most_bytes is not None and start + len(content) > most_bytes:
            raise _too_large(self, path, start + len(content), most_bytes)
        return content

    def open(self, path: str) -> BinaryIO:
        return cast(BinaryIO, Ranges(functools.partial(self._exactly, path), self.plain_size(path)))

    def _exactly(self, path: str, start: int, end: int) -> bytes:
        """Return the bytes [start, end) of a file. Raises UserError if the store returns more or fewer bytes."""
        content = self.read(path, start, end)
        if len(content) != max(end - start, 0):
            found = f"{len(content)} bytes of {max(end - start, 0)}"
            raise UserError(self.at(path), "content", found, "an object that does not change while it is read")
        return content

    def write(self, path: str, content: bytes, *, durable: bool = True) -> None:
        with store_faults(self.at(path)):
            try:
                self._system.pipe_file(self._key(path), content, mode="create")
            except Exception:
                # The library repeats a request whose answer was lost. The repetition fails if the first request wrote
                # the object, which then has the right content.
                size = self.size(path)
                if size is None:
                    raise
                if size != len(content) or self.read(path) != content:
                    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), self.at(path)) from None

    def replace(self, path: str, content: bytes, *, durable: bool = True) -> None:
        with store_faults(self.at(path)):
            self._system.pipe_file(self._key(path), content)

    def sync(self, paths: Iterable[str]) -> None:
        return

    def delete(self, path: str) -> None:
        with store_faults(self.at(path)):
            try:
                self._system.rm_file(self._key(path))
            except FileNotFoundError:
                return

    def delete_below(self, prefix: str) -> None:
        keys = [self._key(item.path) for item in self.list(prefix)]
        with store_faults(self.at(prefix)):
            if keys:  # one request deletes many objects if the store supports it
                self._system.rm(keys)


def open_store(address: Address) -> Store:
    """Open the store at a path, s3://bucket/prefix, gs://bucket/prefix or memory://name.

    Does not read or write files. An open store is returned unchanged. Raises UserError if the kind of address is
    unknown, or if the library of the object store is not installed.
    """
    if isinstance(address, Store):
        return address
    text = os.fspath(address)
    kind, separator, prefix = text.partition("://")
    if not separator or kind == "file":
        return LocalStore(Path(prefix if separator else text))
    prefix = prefix.strip("/")
    if kind not in OBJECT_STORES:
        raise UserError(text, "address", f"{kind}://", _KINDS)
    if not files.is_plain(prefix):
        raise UserError(text, "address", repr(prefix), f"{_KINDS}, of plain names")
    file_system(kind, text)
    return ObjectStore(f"{kind}://{prefix}")


def _too_large(store: Store, path: str, size: int, most_bytes: int) -> UserError:
    return UserError(store.at(path), "size", f"{size} bytes", f"at most {most_bytes}")


def _missing(store: Store, path: str) -> UserError:
    return UserError(store.at(path), "file", "no such file", "a regular file")
