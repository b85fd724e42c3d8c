"""Serve our own interface: read each message whole, then answer it. A client that does not read loses replies."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zmq
import zmq.asyncio
from zmq.utils.monitor import recv_monitor_message

from perilune_render.server.grounds import Grounds
from perilune_render.server.native import answer, refusal
from perilune_render.server.serve import Ask, Limits

LARGEST_REQUEST_BYTES = 4_000_000
MOST_QUEUED = 1
"""Largest number of messages of one client that wait in ZeroMQ, in each direction."""


@dataclass
class Places:
    """The clients that have a place, at most `limits.clients`. A client is known by its identity in ZeroMQ."""

    limits: Limits
    now: Callable[[], float] = time.monotonic
    """Seconds from any time."""
    waiting: set[bytes] = field(default_factory=set)
    """Clients that wait for a reply."""
    _last: dict[bytes, float] = field(default_factory=dict)
    """Time of the last request or reply of each client that has a place."""
    _connection: dict[bytes, int] = field(default_factory=dict)
    """File descriptor of the connection of each client that has a place and is connected."""

    def __len__(self) -> int:
        return len(self._last)

    def taken(self, client: bytes, connection: int) -> bool:
        """Give a place to a client, or keep it; False if all are taken by clients that were not idle for long."""
        if client not in self._last and len(self._last) >= self.limits.clients:
            oldest = self.now() - self.limits.idle_s
            for other in [each for each, last in self._last.items() if last < oldest and each not in self.waiting]:
                self._forget(other)
            if len(self._last) >= self.limits.clients:
                return False
        self._last[client], self._connection[client] = self.now(), connection
        return True

    def replied(self, client: bytes) -> None:
        """End the wait of a client; it loses its place if it left meanwhile."""
        self.waiting.discard(client)
        if client in self._connection:
            self._last[client] = self.now()
        else:
            self._forget(client)

    def disconnected(self, connection: int) -> None:
        """Free the place of the client of a connection."""
        for client in [each for each, own in self._connection.items() if own == connection]:
            self.left(client)

    def left(self, client: bytes) -> None:
        """Free the place of a client, at once or after the reply that it waits for."""
        self._connection.pop(client, None)
        if client not in self.waiting:
            self._forget(client)

    def _forget(self, client: bytes) -> None:
        self._last.pop(client, None)
        self._connection.pop(client, None)


def native_address(host: str, port: int) -> str:
    """The address for ZeroMQ; one of IPv6 is in brackets."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


async def serve_native(
    address: str,
    grounds: Grounds,
    ask: Ask,
    ready: Callable[[int], object],
    limits: Limits,
    note: Callable[[str], object],
) -> None:
    """Answer requests at a ZeroMQ address until cancelled; `ready` is called with the port.

    A client has one request at a time: another one before the reply is refused. So is one of a client without a place.
    `note` is called with a line on each error that is not the client's.
    """
    context = zmq.asyncio.Context()
    socket = context.socket(zmq.ROUTER)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.IPV6, 1)
    socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_REQUEST_BYTES)
    # With this option an error says that a client left, or that it has as many messages to read as may be queued.
    socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
    socket.setsockopt(zmq.SNDHWM, MOST_QUEUED)
    socket.setsockopt(zmq.RCVHWM, MOST_QUEUED)
    places, tasks = Places(limits), set[asyncio.Task]()

    async def send(envelope: list[bytes], reply: list[bytes]) -> None:
        socket.get(zmq.EVENTS)  # makes ZeroMQ count what the client has read by now
        try:
            await socket.send_multipart([*envelope, *reply], zmq.DONTWAIT)
        except zmq.Again:
            return  # the client does not read: discard the reply
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            places.left(envelope[0])

    async def handle(envelope: list[bytes], content: bytes) -> None:
        client = envelope[0]
        try:
            reply = await ask(lambda: answer(grounds, content, client))
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            note(f"perilune_shared.client: {text}")
            reply = refusal(text)
        try:
            await send(envelope, reply)
        finally:
            places.replied(client)

    def begin(work: Any) -> None:
        task = asyncio.ensure_future(work)
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    monitor = socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)

    async def watch() -> None:
        while True:
            places.disconnected((await recv_monitor_message(monitor))["value"])

    try:
        try:
            socket.bind(address)
        except zmq.ZMQError as error:
            raise OSError(f"{address}: {error}") from None
        ready(int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2]))
        begin(watch())
        while True:
            first, *parts = await socket.recv_multipart(copy=False)
            client, connection = first.bytes, first.get(zmq.SRCFD)
            empty = [b""] if len(parts) > 1 and len(parts[0]) == 0 else []
            envelope = [client, *empty]
            if len(parts) != 1 + len(empty):
                await send(envelope, refusal(f"message: got {len(parts)} parts, expected an empty one and JSON"))
            elif client in places.waiting:
                await send(envelope, refusal("one request at a time"))
            elif not places.taken(client, connection):
                await send(envelope, refusal(f"{limits.clients} clients are connected; try again", busy=True))
            else:
                places.waiting.add(client)
                begin(handle(envelope, parts[-1].bytes))
    finally:
        for task in tasks:
            task.cancel()
        socket.disable_monitor()
        monitor.close(0)
        socket.close()
        context.term()
