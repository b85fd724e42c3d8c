"""Open object stores with fsspec, and convert their exceptions to errors that name the address."""

import contextlib
import os
import re
from collections.abc import Iterator
from typing import Any

from perilune_shared.errors import UserError, one_line

OBJECT_STORES = {"s3": "s3", "gs": "gcs", "memory": ""}
"""Kinds of object stores, with the extra of perilune-shared that each kind needs; empty if it needs no extra."""
_TIMEOUTS_S = {"connect_timeout": 10, "read_timeout": 60}
_LIBRARIES = ("aiohttp", "aiobotocore", "botocore", "fsspec", "gcsfs", "google", "requests", "s3fs", "urllib3")
"""Packages whose exceptions `store_faults` converts, besides OSError."""
_ACCESS = re.compile(r"credential|token|accessdenied|forbidden|signature|access key|\b40[13]\b", re.I)
"""Messages about missing access. 401 and 403 match only as whole words, since a port number may contain them."""
_CREDENTIALS = {
    "s3": "credentials with access to it: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE",
    "gs": "credentials with access to it: GOOGLE_APPLICATION_CREDENTIALS, or `gcloud auth application-default login`",
}


def file_system(kind: str, address: str) -> Any:
    """Return fsspec's file system for a kind of store; `address` is for messages.

    Listings are not cached, since other processes may write. Raises UserError if the library of the store is missing.
    """
    import fsspec

    options: dict[str, Any] = {} if kind == "memory" else {"use_listings_cache": False}
    if kind == "s3":
        # fsspec reuses a file system if the options are equal. With AWS_ENDPOINT_URL among the options, a new value
        # of the variable opens a new file system.
        options |= {"endpoint_url": os.environ.get("AWS_ENDPOINT_URL"), "config_kwargs": _TIMEOUTS_S}
    try:
        with store_faults(address):
            return fsspec.filesystem(kind, **options)
    except ImportError:
        expected = f"the extra {OBJECT_STORES[kind]}: pip install 'perilune-shared[{OBJECT_STORES[kind]}]'"
        raise UserError(address, "address", f"{kind}:// without its library", expected) from None


def is_missing_bucket(error: Exception) -> bool:
    """Whether an exception reports a missing bucket, not only a missing object."""
    return isinstance(error, FileNotFoundError) and "specified bucket" in str(error).lower()


@contextlib.contextmanager
def store_faults(address: str) -> Iterator[None]:
    """Convert any exception of an object store to a UserError that names `address`.

    Failed requests are not repeated here, since the library of the store repeats them. FileExistsError and
    FileNotFoundError about a single object are not converted, since callers handle them.
    """
    try:
        yield
    except (FileExistsError, UserError):
        raise
    except Exception as error:
        text = one_line(f"{type(error).__name__}: {error}")
        if is_missing_bucket(error):
            raise UserError(address, "bucket", "no such bucket", "the name of an existing bucket") from None
        if isinstance(error, FileNotFoundError):
            raise
        if not isinstance(error, OSError) and type(error).__module__.partition(".")[0] not in _LIBRARIES:
            raise
        if isinstance(error, PermissionError) or _ACCESS.search(text):
            expected = _CREDENTIALS.get(address.partition("://")[0], "access to it")
            raise UserError(address, "access", text, expected) from None
        expected = "a store that answers; run the same command again to resume"
        raise UserError(address, "connection", text, expected) from None
