"""Write a new dataset to a local folder or an object store so that it appears as a whole or not at all."""

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
    """Yield a store for new files; remove what was written on any failure.

    A local folder is renamed to `out` at the end. In an object store, the file `claim` excludes other writers, since it
    is written only if it does not exist. `content` is its content, the JSON of an unfinished dataset; the caller
    replaces this file last. Raises UserError if `out` is not empty or another process is writing to it.
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
    """Yield a local folder for new files, which become the files at `out` when the block ends without an error.

    The folder is renamed to a local `out`. Into an object store the files are copied; existing objects are not
    overwritten, and on any failure the copies are removed. Raises UserError if `out` is not empty or another process is
    writing to it.
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
