"""A client's connection, with time limits on its messages and size limits on its requests."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

Ask = Callable[[Callable[[], Any]], Awaitable[Any]]
"""Runs a function in the thread that renders, and returns its result."""


class Dropped(Exception):
    """Ends a connection; the text gives the reason."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits on the clients and their requests."""

    clients: int = 16
    """Largest number of connected clients."""
    idle_s: float = 600.0
    """Longest silence between two messages before a client is disconnected, seconds."""
    message_s: float = 30.0
    """Longest time until the hello arrives, a started message is complete, or a reply is read, seconds."""
    items: int = 100_000
    """Largest number of items in an array of a message."""
    item_bytes: int = 4_000_000
    """Largest size of an array of a message, bytes."""


@dataclass(eq=False)
class Connection:
    """The connection of one client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    limits: Limits
    ask: Ask
    """Runs a function in the thread that renders."""
    name: str = ""
    """Address of the client, for messages."""
    is_extra: bool = False
    """Whether the client is beyond the limit of clients, so that it gets an error."""
    has_asked: bool = False
    """Whether the client has sent a complete request."""
    heard_s: float = field(default_factory=time.monotonic)
    """Time at which the client connected or last sent something, by `time.monotonic`."""
    _due_s: float = 0.0
    """Time by which the current message must be complete, by `time.monotonic`."""

    async def hello(self, n_bytes: int) -> bytes:
        """The bytes that a client sends first. Raises TimeoutError after `limits.message_s`."""
        self._due_s = time.monotonic() + self.limits.message_s
        return await self.rest(n_bytes)

    async def first(self, n_bytes: int) -> bytes:
        """The first bytes of a message.

        Raises TimeoutError if no byte arrives in `limits.idle_s`, or if the other bytes do not follow the first byte in
        `limits.message_s`.
        """
        async with asyncio.timeout(self.limits.idle_s):
            begun = await self.reader.readexactly(1)
        self._due_s = time.monotonic() + self.limits.message_s
        return begun + await self.rest(n_bytes - 1)

    async def rest(self, n_bytes: int) -> bytes:
        """The next bytes of a message. Raises TimeoutError if `limits.message_s` have passed since it began."""
        async with asyncio.timeout(self._due_s - time.monotonic()):
            data = await self.reader.readexactly(n_bytes)
        self.heard_s = time.monotonic()
        return data

    async def send(self, data: bytes) -> None:
        """Send a reply in one write. Raises TimeoutError if the client does not read it in `limits.message_s`."""
        self.writer.write(data)
        # Not `wait_for`, which in Python 3.11 loses a cancellation that arrives while it returns.
        async with asyncio.timeout(self.limits.message_s):
            await self.writer.drain()
