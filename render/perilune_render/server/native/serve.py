"""Serve perilune's native interface: read each message completely, then answer it."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from perilune_render.server.connection import Connection, Limits
from perilune_render.server.grounds import Grounds
from perilune_render.server.native import zmtp
from perilune_render.server.native.answers import ANSWERED_BY_CONNECTIONS, answer, refusal
from perilune_render.server.serve import Interface, answers

MAX_REFUSED = 256
"""Largest number of connected clients beyond the limit; they get the reply that the server is busy."""
HEALTH = b'{"request": "health"}'
"""The health request of `perilune_shared.client`, which is also answered beyond the limit of clients."""
_HEALTH_S = 5.0
"""Time within which each interface must send its greeting, seconds."""


def native_address(host: str, port: int) -> str:
    """The address in ZeroMQ's form; an IPv6 address is put in brackets."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


@dataclass
class Native:
    """The native interface of a server."""

    grounds: Grounds
    """The scenes."""
    limits: Limits
    """Limits on the clients. Clients beyond the limit get the reply that the server is busy."""
    note: Callable[[str], object]
    """Function that is called with one line for each error that is not caused by a client."""
    interfaces: list[Interface] = field(default_factory=list)
    """All interfaces of the server, for the health request."""
    _admitted: set[Connection] = field(default_factory=set)
    """Admitted clients: at most `limits.clients`, each from its first request until it disconnects."""

    def interface(self, host: str, port: int) -> Interface:
        """Make the interface that listens at an address."""
        connected = replace(self.limits, clients=self.limits.clients + MAX_REFUSED)
        interface = Interface("perilune_shared.client", host, port, self._serve, zmtp.greets, connected)
        self.interfaces.append(interface)
        return interface

    async def _serve(self, connection: Connection) -> None:
        """Serve one client until it leaves."""
        if connection.is_extra:
            return
        await zmtp.greet(connection)
        try:
            while True:
                message = await zmtp.receive(connection, lambda: self._admit(connection))
                connection.has_asked = True
                empty = [b""] if message.n_parts > 1 and message.kept[:1] == [b""] else []
                await zmtp.send(connection, [*empty, *await self._reply(connection, message, len(empty))])
        finally:
            self._admitted.discard(connection)

    def _admit(self, connection: Connection) -> bool:
        """Admit a client if fewer than `limits.clients` are admitted; return whether it is admitted."""
        if connection not in self._admitted and len(self._admitted) < self.limits.clients:
            self._admitted.add(connection)
        return connection in self._admitted

    async def _reply(self, connection: Connection, message: zmtp.Message, n_empty: int) -> list[bytes]:
        if message.n_parts != 1 + n_empty:
            return refusal(f"message: got {message.n_parts} parts, expected an empty one and JSON")
        # A server with the largest number of clients still answers health requests.
        if not message.is_whole or (message.kept[-1] != HEALTH and not self._admit(connection)):
            return refusal(f"{self.limits.clients} clients are connected; try again", busy=True)
        try:
            reply = await connection.ask(lambda: answer(self.grounds, message.kept[-1], connection))
        except ConnectionAbortedError:
            raise  # the server ends
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            self.note(f"perilune_shared.client: {text}")
            return refusal(text)
        return await self._health() if reply is ANSWERED_BY_CONNECTIONS else reply

    async def _health(self) -> list[bytes]:
        """The reply to a health request: all interfaces with addresses, or an error about one that does not answer."""
        for each in self.interfaces:
            where = f"{each.name} at {each.host}:{each.port}"
            try:
                async with asyncio.timeout(_HEALTH_S):
                    if not await answers(each):
                        return refusal(f"{where}: does not answer")
            except TimeoutError:
                return refusal(f"{where}: does not answer in {_HEALTH_S:g} s")
            except (OSError, asyncio.IncompleteReadError) as error:
                return refusal(f"{where}: does not answer: {error}")
        return [
            json.dumps({"interfaces": {each.name: f"{each.host}:{each.port}" for each in self.interfaces}}).encode()
        ]
