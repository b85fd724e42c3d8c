"""Read an object in byte ranges, with few requests."""

import contextlib
import io
from collections.abc import Callable, Iterable, Iterator
from typing import Any

_BLOCK_BYTES = 2**22
_MAX_GAP_BYTES = 2**18
"""Maximum gap between ranges that share a request: a further request takes longer than reading this many bytes."""
_MARGIN_BYTES = 2**14
"""Bytes read beyond each range, for readers that do not know where a header ends."""


class Ranges(io.RawIOBase):
    """A stored object as a read-only file.

    Bytes that were read ahead by `keep` or `fetched` come from memory; others are read in blocks of 4 MiB.
    """

    def __init__(self, read: Callable[[int, int], bytes], size_bytes: int):
        """`read` returns the bytes [start, end) of the object, with one request."""
        self._read, self.size_bytes, self._at = read, size_bytes, 0
        self._kept: list[tuple[int, bytes]] = []
        self._fetched: list[tuple[int, bytes]] = []
        self._block = (0, b"")

    def keep(self, start: int) -> None:
        """Read the bytes from `start` to the end with one request, and keep them."""
        self._kept.append((start, self._read(start, self.size_bytes)))

    @contextlib.contextmanager
    def fetched(self, ranges: Iterable[tuple[int, int]]) -> Iterator[None]:
        """Read ranges (start, end), and keep them within the block; neighbouring ranges share a request."""
        joined: list[list[int]] = []
        for start, end in sorted(ranges):
            first, last = max(start, 0), min(end + _MARGIN_BYTES, self.size_bytes)
            if joined and first <= joined[-1][1] + _MAX_GAP_BYTES:
                joined[-1][1] = max(joined[-1][1], last)
            else:
                joined.append([first, last])
        try:
            self._fetched = [(first, self._read(first, last)) for first, last in joined]
            yield
        finally:
            self._fetched = []

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size_bytes}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        count = max(min(len(buffer), self.size_bytes - self._at), 0)
        content = self._bytes(self._at, self._at + count) if count else b""
        buffer[: len(content)] = content
        self._at += len(content)
        return len(content)

    def _bytes(self, start: int, end: int) -> bytes | memoryview:
        for first, content in (*self._kept, *self._fetched, self._block):
            if first <= start and end <= first + len(content):
                return memoryview(content)[start - first : end - first]
        self._block = (start, self._read(start, min(max(end, start + _BLOCK_BYTES), self.size_bytes)))
        return self._block[1][: end - start]
