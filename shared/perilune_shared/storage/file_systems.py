"""Open fsspec's file systems of object stores, and files in them."""

import io
import os
from typing import Any, BinaryIO, cast

from perilune_shared.errors import UserError
from perilune_shared.storage.store_faults import store_faults

OBJECT_STORES = {"s3": "s3", "gs": "gcs", "memory": ""}
"""Kinds of object stores, and the extra of perilune-shared that each needs."""
_TIMEOUTS_S = {"connect_timeout": 10, "read_timeout": 60}
_BLOCK_BYTES = 2**22


def file_system(kind: str, address: str) -> Any:
    """Return fsspec's file system for a kind of address; listings are never cached, since others may write."""
    import fsspec

    options: dict[str, Any] = {} if kind == "memory" else {"use_listings_cache": False}
    if kind == "s3":
        # Part of the key by which fsspec keeps file systems: the variable may change within a process.
        options |= {"endpoint_url": os.environ.get("AWS_ENDPOINT_URL"), "config_kwargs": _TIMEOUTS_S}
    try:
        with store_faults(address):
            return fsspec.filesystem(kind, **options)
    except ImportError:
        expected = f"the extra {OBJECT_STORES[kind]}: pip install 'perilune-shared[{OBJECT_STORES[kind]}]'"
        raise UserError(address, "address", f"{kind}:// without its library", expected) from None


def open_ranges(system: Any, key: str, address: str) -> BinaryIO:
    """Open a file for reading; ranges are fetched in blocks, of which the last ones used are kept.

    Raises FileNotFoundError if it is missing; reading raises UserError about `address`.
    """
    opened = system.open(key, "rb", block_size=_BLOCK_BYTES, cache_type="blockcache")
    return cast(BinaryIO, io.BufferedReader(_Ranges(opened, address), _BLOCK_BYTES // 64))


class _Ranges(io.RawIOBase):
    """A file opened by fsspec, whose faults are UserErrors."""

    def __init__(self, opened: Any, address: str):
        self._opened, self._address = opened, address

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return int(self._opened.seek(offset, whence))

    def tell(self) -> int:
        return int(self._opened.tell())

    def readinto(self, buffer: Any) -> int:
        with store_faults(self._address):
            content = self._opened.read(len(buffer))
        buffer[: len(content)] = content
        return len(content)

    def close(self) -> None:
        if not self.closed:
            self._opened.close()
        super().close()
