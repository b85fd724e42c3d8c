"""Write a new dataset so that it appears whole or not at all, in a local folder or at an address."""

import contextlib
import secrets
from collections.abc import Iterator

from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.store import Address, LocalStore, Store, open_store

_NONCE_BITS = 64


@contextlib.contextmanager
def new_store(out: Address, claim: str, content: bytes) -> Iterator[Store]:
    """Yield a store for new files; remove what was written on any failure.

    A local folder is renamed to `out` at the end. In an object store, the create-only write of the file `claim`
    excludes other writers. Its `content` is JSON of an unfinished dataset; the caller replaces it last. Raises
    UserError if `out` is not empty or another process is writing it.
    """
    store = open_store(out)
    if store.folder is not None:
        with files.new_folder(store.folder) as aside:
            yield LocalStore(aside)
        return
    if next(iter(store.list()), None) is not None:
        raise _occupied(store)
    # Blanks at the end of JSON mean nothing; they tell the claims of two writers apart.
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


def _occupied(store: Store) -> UserError:
    return UserError(store, "--out", "an address that is not empty", "a new prefix, or delete what is below it")
