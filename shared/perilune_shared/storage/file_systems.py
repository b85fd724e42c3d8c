"""Open fsspec's file systems of object stores."""

import os
from typing import Any

from perilune_shared.errors import UserError
from perilune_shared.storage.store_faults import store_faults

OBJECT_STORES = {"s3": "s3", "gs": "gcs", "memory": ""}
"""Kinds of object stores, and the extra of perilune-shared that each needs."""
_TIMEOUTS_S = {"connect_timeout": 10, "read_timeout": 60}


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
