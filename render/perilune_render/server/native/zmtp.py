"""Frames of ZeroMQ's wire protocol, ZMTP 3.0 without encryption (https://rfc.zeromq.org/spec/23).

ZeroMQ's library collects all parts of a message before it passes them to a program, so one client could fill the
memory. This module keeps only the first two parts, and ends the connection if a part exceeds LARGEST_REQUEST_BYTES.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple

from perilune_render.server.connection import Connection, Dropped

LARGEST_REQUEST_BYTES = 4_000_000
"""Largest size of a part of a message, bytes."""
_LARGEST_COMMAND_BYTES = 4096
_MAX_KEPT = 2
_CHUNK_BYTES = 65_536
_MORE, _LONG, _COMMAND = 1, 2, 4
_SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
_GREETING = _SIGNATURE + b"\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
_SOCKETS = (b"REQ", b"DEALER", b"ROUTER")
"""Types of ZeroMQ sockets that may connect to the server, which is a ROUTER."""


class Message(NamedTuple):
    """A message of a client."""

    kept: list[bytes]
    """The first two parts, without those that `receive` discarded."""
    n_parts: int
    """Number of parts that were sent."""
    is_whole: bool
    """Whether `kept` holds all of the first two parts."""


async def greet(connection: Connection) -> None:
    """Exchange greetings and the types of the sockets.

    Raises Dropped if the client does not use ZMTP 3.
    """
    signature = await connection.hello(1)
    if signature != _SIGNATURE[:1]:
        raise Dropped("not a client of ZeroMQ 4")
    signature += await connection.rest(len(_SIGNATURE) - 1)
    if signature[-1] & 1 == 0:
        raise Dropped("not a client of ZeroMQ 4")
    # The other side waits for our greeting before it sends the rest of its greeting.
    await connection.send(_GREETING)
    rest = await connection.rest(len(_GREETING) - len(_SIGNATURE))
    if rest[0] < 3 or rest[2:22] != _GREETING[12:32]:
        raise Dropped("ZMTP before version 3, or with encryption")
    await connection.send(_frame(_COMMAND, b"\x05READY" + _property(b"Socket-Type", b"ROUTER")))
    flags, size = await _head(connection, await connection.rest(1))
    command = await connection.rest(size) if flags & _COMMAND else b""
    if not any(_property(b"Socket-Type", kind) in command for kind in _SOCKETS):
        raise Dropped("not a socket of type REQ or DEALER")


async def receive(connection: Connection, may_keep: Callable[[], bool]) -> Message:
    """The next message of a client.

    `may_keep` decides whether a part of more than 64 KiB is kept or discarded. Raises Dropped if a part is too large,
    and TimeoutError like `Connection.first` and `Connection.rest`.
    """
    kept: list[bytes] = []
    n_parts, is_whole = 0, True
    while True:
        flags, size = await _head(connection, await (connection.rest(1) if n_parts else connection.first(1)))
        if flags & _COMMAND:
            await _obey(connection, await connection.rest(size))
            continue
        is_wanted = len(kept) < _MAX_KEPT
        is_kept = is_wanted and (size <= _CHUNK_BYTES or may_keep())
        is_whole = is_whole and (is_kept or not is_wanted)
        if is_kept:
            kept.append(await connection.rest(size))
        else:
            while size > 0:
                size -= len(await connection.rest(min(size, _CHUNK_BYTES)))
        n_parts += 1
        if not flags & _MORE:
            return Message(kept, n_parts, is_whole)


async def send(connection: Connection, parts: Sequence[bytes]) -> None:
    """Send a message. Raises TimeoutError if the client does not read it."""
    last = len(parts) - 1
    await connection.send(b"".join(_frame(_MORE if n < last else 0, part) for n, part in enumerate(parts)))


async def greets(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
    """Whether the other end of a new connection sends the greeting of a ZMTP 3 server."""
    writer.write(_GREETING)
    return await reader.readexactly(len(_GREETING)) == _GREETING


async def _head(connection: Connection, first: bytes) -> tuple[int, int]:
    """Flags and size of a frame. `first` is its first byte."""
    flags = first[0]
    size = int.from_bytes(await connection.rest(8 if flags & _LONG else 1), "big")
    if flags > _MORE + _LONG + _COMMAND or (flags & _COMMAND and (flags & _MORE or size > _LARGEST_COMMAND_BYTES)):
        raise Dropped("an impossible frame")
    if size > LARGEST_REQUEST_BYTES:
        raise Dropped(f"a part of {size} bytes, expected at most {LARGEST_REQUEST_BYTES}")
    return flags, size


async def _obey(connection: Connection, command: bytes) -> None:
    """Answer a PING command; ignore other commands.

    A ping holds the client's time limit (2 bytes) and a text (at most 16 bytes), which is sent back.
    """
    if command.startswith(b"\x04PING"):
        await connection.send(_frame(_COMMAND, b"\x04PONG" + command[7:23]))


def _frame(flags: int, content: bytes) -> bytes:
    if len(content) > 255:
        return bytes([flags | _LONG]) + len(content).to_bytes(8, "big") + content
    return bytes([flags, len(content)]) + content


def _property(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + len(value).to_bytes(4, "big") + value
