"""Turn the exceptions of object stores into errors of one line with the address."""

import contextlib
import re
from collections.abc import Iterator

from perilune_shared.errors import UserError, one_line

_LIBRARIES = ("aiohttp", "aiobotocore", "botocore", "fsspec", "gcsfs", "google", "requests", "s3fs", "urllib3")
"""Libraries below fsspec that raise exceptions of their own."""
_ACCESS = re.compile(r"credential|token|accessdenied|forbidden|signature|access key|\b40[13]\b", re.I)
"""The status as a word of its own: the number of a port may hold it."""
_CREDENTIALS = {
    "s3": "credentials with access to it: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE",
    "gs": "credentials with access to it: GOOGLE_APPLICATION_CREDENTIALS, or `gcloud auth application-default login`",
}


def is_missing_bucket(error: Exception) -> bool:
    """Whether an exception says that the bucket is missing, not only an object in it."""
    return isinstance(error, FileNotFoundError) and "specified bucket" in str(error).lower()


@contextlib.contextmanager
def store_faults(address: str) -> Iterator[None]:
    """Raise UserError about `address` instead of any exception of an object store, after the library's retries.

    FileExistsError and FileNotFoundError about one object pass unchanged: callers handle them.
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
