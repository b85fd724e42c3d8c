"""Write a new dataset to a folder or an object store so that it appears as a whole or not at all."""

import contextlib
import secrets
import tempfile
from collections.abc import Iterator
from pathlib import Path

from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.store import Address, LocalStore, Store, open_store

_NONCE_BITS = 64


@contextlib.contextmanager
def new_store(out: Address, claim: str, content: bytes) -> Iterator[Store]:
    """Yield a store for the files of a new dataset; on any failure, remove the written files.

    For a local `out`, the store is a hidden folder, which is renamed to `out` at the end. In an object store, the file
    `claim` is written first, and only if it does not exist, so it excludes other writers. `content`, the JSON of an
    unfinished dataset, is the content of this file; the caller replaces the file last. Raises UserError if `out` is not
    empty or another process is writing to it.
    """
    store = open_store(out)
    if store.folder is not None:
        with files.new_folder(store.folder) as aside:
            yield LocalStore(aside)
        return
    check_empty(store)
    # Trailing blanks have no meaning in JSON, so they can distinguish the claims of two writers.
    nonce = "".join(" \t"[int(bit)] for bit in f"{secrets.randbits(_NONCE_BITS):0{_NONCE_BITS}b}")
    try:
        store.write(claim, content + nonce.encode() + b"\n")
    except FileExistsError:
        raise _occupied(store) from None
    try:
        yield store
    except BaseException:
        for item in [*store.list()]:
            if item.path != claim:
                store.delete(item.path)
        store.delete(claim)
        raise


@contextlib.contextmanager
def new_files(out: Address) -> Iterator[Path]:
    """Yield a local folder for new files; at the end of the block, move the files to `out`.

    If the block raises an error, nothing is written to `out`. For a local `out`, the folder is renamed. If `out` is in
    an object store, the files are copied, and a failed copy removes the copied files. Existing objects are never
    overwritten: if another process writes there at the same time, the copy stops with a UserError and removes nothing,
    since objects of equal content may belong to that process. Raises UserError too if `out` is not empty.
    """
    store = open_store(out)
    if store.folder is not None:
        with files.new_folder(store.folder) as aside:
            yield aside
        return
    check_empty(store)
    with tempfile.TemporaryDirectory(prefix="perilune-") as folder:
        yield Path(folder)
        written = []
        try:
            for item in LocalStore(Path(folder)).list():
                store.write(item.path, Path(folder, item.path).read_bytes())
                written.append(item.path)
        except FileExistsError:
            raise _occupied(store) from None
        except BaseException:
            for path in written:
                store.delete(path)
            raise


def check_empty(out: Address) -> None:
    """Raise UserError if an address for new files is not empty."""
    store = open_store(out)
    if store.folder is not None:
        files.check_free(store.folder)
    elif next(iter(store.list()), None) is not None:
        raise _occupied(store)


def _occupied(store: Store) -> UserError:
    return UserError(store, "--out", "an address that is not empty", "a new prefix, or delete what is below it")
