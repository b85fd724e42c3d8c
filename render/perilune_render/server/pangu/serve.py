"""Serve PANGU's protocol: read each message of a client completely, then answer it."""

import asyncio
import socket
import time
from collections.abc import Callable

import numpy as np

from perilune_render.server.connection import Connection
from perilune_render.server.pangu import messages as m
from perilune_render.server.pangu.answers import answer
from perilune_render.server.pangu.session import Session
from perilune_render.server.pangu.wire import (
    FAULTY,
    REFUSED,
    doubles_from,
    error,
    expanded,
    floats_from,
    read_fields,
    size_of,
    unsigned,
)

_MAJOR, _LARGEST_MINOR = divmod(m.VERSION, 256)


async def serve_pangu(connection: Connection, new_session: Callable[[], Session], quit_server: Callable) -> None:
    """Serve one session until the client sends Goodbye or disconnects."""
    _set_no_delay(connection)
    major, minor = divmod(int.from_bytes(await connection.hello(4), "big"), 256)
    if connection.is_extra:
        await connection.send(error(REFUSED, f"{connection.limits.clients} clients are connected, the most allowed"))
        return
    if major != _MAJOR or minor > _LARGEST_MINOR:
        text = f"protocol version {major}.{minor}, expected {_MAJOR}.0 to {_MAJOR}.{_LARGEST_MINOR}"
        await connection.send(error(FAULTY, text))
        return
    await connection.send(unsigned(m.OKAY))
    session = new_session()
    while True:
        number = int.from_bytes(await connection.first(4), "big")
        message = m.MESSAGES.get(number)
        if message is None:
            # Messages do not state their length, so the next message cannot be found.
            await connection.send(error(FAULTY, f"message {number} is not one of protocol 1.20; the session ends"))
            return
        values = read_fields(message.fields, await connection.rest(size_of(message.fields)))
        n_items = m.count_of(message, values) if message.item else 0
        if n_items > connection.limits.items or n_items * size_of(message.item) > connection.limits.item_bytes:
            text = f"{message.name}: {n_items} items, expected at most {connection.limits.items}; the session ends"
            await connection.send(error(FAULTY, text))
            return
        data = await connection.rest(n_items * size_of(message.item))
        connection.has_asked = True
        if number == m.GOODBYE:
            return
        if number == m.QUIT:
            allowed = session.conventions.may_quit
            text = "Quit: start the server with --allow-quit to permit this"
            await connection.send(unsigned(m.OKAY) if allowed else error(FAULTY, text))
            if allowed:
                quit_server()
                return
            continue
        items = items_of(message, data)
        session.asked_us = time.time() * 1e6
        await connection.send(await connection.ask(lambda: answer(session, message, values, items)))  # noqa: B023


async def greets(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
    """Whether the other end of a new connection sends the greeting of a PANGU server."""
    writer.write(unsigned(m.VERSION))
    greeting = await reader.readexactly(4)
    writer.write(unsigned(m.GOODBYE))
    return greeting == unsigned(m.OKAY)


def items_of(message: m.Message, data: bytes) -> np.ndarray | bytes:
    """The array of a message: numbers (N, k) if all its fields are floats or all are doubles, otherwise bytes."""
    kinds = set(expanded(message.item))
    if kinds == {"f"}:
        return floats_from(data).reshape(-1, len(expanded(message.item)))
    if kinds == {"d"}:
        return doubles_from(data).reshape(-1, len(expanded(message.item)))
    return data


def _set_no_delay(connection: Connection) -> None:
    raw = connection.writer.get_extra_info("socket")
    if raw is not None:
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
