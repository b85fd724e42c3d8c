"""The server: it accepts many clients, and one thread answers their requests one after another.

The main thread renders, since Blender must run in it. An event loop in a second thread handles the connections of all
interfaces. It reads the next request of a client only after the previous one is answered, so each client has at most
one request in the queue. If the second thread ends for any reason except `stop`, `run` raises an error.
"""

import asyncio
import contextlib
import queue
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from perilune_render.server.connection import Connection, Dropped, Limits
from perilune_shared.errors import UserError

_STOP_S = 5.0
_WATCH_S = 1.0
"""Interval between checks that the ports are still open, seconds."""
_NOTES_S = 1.0
"""Time to wait for the last log lines when the server ends, seconds."""
_GRACE_S = 1.0
"""Shortest silence after which a client without any request may be dropped for a new client, seconds."""
_EXTRA_S = 2.0
"""Time within which a client beyond the limit must send its hello and read the error, seconds."""


class LineQueue:
    """Passes lines to a function in a separate thread, without ever blocking the caller.

    While the function blocks, for example on a full pipe, up to `most` lines wait, and further lines are dropped.
    """

    def __init__(self, note: Callable[[str], object], most: int = 1000):
        self._note = note
        self._lines: queue.Queue[str | None] = queue.Queue(most)
        self._thread = threading.Thread(target=self._pass_on, name="notes", daemon=True)
        self._thread.start()

    def __call__(self, text: str) -> None:
        """Queue a line, or drop it if the queue is full."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(text)

    def close(self, wait_s: float) -> None:
        """Pass on the queued lines; stop waiting after about `wait_s` seconds."""
        with contextlib.suppress(queue.Full):
            self._lines.put(None, timeout=wait_s)
            self._thread.join(wait_s)

    def _pass_on(self) -> None:
        while (text := self._lines.get()) is not None:
            # A closed pipe must stop neither this thread nor the server.
            with contextlib.suppress(Exception):
                self._note(text)


@dataclass(eq=False)
class Interface:
    """A port of the server, and the function that serves its clients."""

    name: str
    """Name of the protocol, for messages."""
    host: str
    """Address to listen on."""
    port: int
    """Port; 0 takes a free port, whose number then replaces the 0."""
    handle: Callable[[Connection], Awaitable[None]]
    """Coroutine function that serves one connection until it ends. May raise `Dropped`."""
    greets: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[bool]]
    """Coroutine function that returns whether the other end of a new connection sends this interface's greeting."""
    limits: Limits
    """Limits on the clients."""
    clients: set[Connection] = field(default_factory=set)
    """The connections within the limit of clients."""
    probes: set[int] = field(default_factory=set)
    """Ports from which the server itself connects to check that the interface answers."""
    n_extra: int = 0
    """Number of connections beyond the limit of clients."""
    listening: asyncio.Server | None = None
    """Socket server that accepts connections; None before the server begins."""


@dataclass
class Server:
    """Accepts clients in a separate thread; `run` answers their requests in the calling thread."""

    interfaces: list[Interface]
    note: Callable[[str], object]
    """Function that is called with one line per event, in a separate thread; it may block."""
    _ready: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _work: "queue.Queue[tuple[Callable[[], Any], Future[Any]] | None]" = field(default_factory=queue.Queue)
    _loop: asyncio.AbstractEventLoop | None = None
    _failure: BaseException | None = None
    _ending: asyncio.Event = field(default_factory=asyncio.Event)
    _tasks: set = field(default_factory=set)
    _notes: LineQueue | None = None

    def begin(self) -> None:
        """Accept clients. Raises UserError if an address cannot be used."""
        self._notes = LineQueue(self.note)
        self._thread = threading.Thread(target=self._accept, name="connections", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def run(self) -> None:
        """Answer requests until `stop` is called.

        Raises UserError if the thread of the connections ended by itself.
        """
        try:
            while (item := self._work.get()) is not None:
                _answer(*item)
        finally:
            if self._loop is not None:
                with contextlib.suppress(RuntimeError):  # the loop is already closed
                    self._loop.call_soon_threadsafe(self._ending.set)
            if self._thread is not None:
                self._thread.join(_STOP_S)
            if self._notes is not None:
                self._notes.close(_NOTES_S)
        if self._failure is not None:
            actual = f"ended by {type(self._failure).__name__}: {self._failure}"
            raise UserError("serve", "connections", actual, "a server that answers; start it again") from self._failure

    def stop(self) -> None:
        """End `run`; may be called from any thread."""
        self._work.put(None)

    def _accept(self) -> None:
        """Accept and serve connections; the body of the second thread. When it fails, `run` ends too."""
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._on_error)
        try:
            self._loop.run_until_complete(self._listen())
            self._ready.set()
            self._loop.run_until_complete(self._watch())
        except BaseException as error:
            self._failure = error
            self._ready.set()
            self._work.put(None)
        finally:
            with contextlib.suppress(Exception):
                self._loop.run_until_complete(self._disconnect())
                self._loop.close()

    async def _watch(self) -> None:
        """Wait until the server ends. Raises RuntimeError if a port is no longer open."""
        while not self._ending.is_set():
            for each in self.interfaces:
                if each.listening is None or not each.listening.is_serving():
                    raise RuntimeError(f"{each.name}: port {each.port} is closed")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_WATCH_S):
                    await self._ending.wait()

    async def _listen(self) -> None:
        """Accept connections at every interface. Raises UserError if an address cannot be used."""
        try:
            for each in self.interfaces:
                each.listening = await asyncio.start_server(partial(self._connected, each), each.host, each.port)
                each.port = each.listening.sockets[0].getsockname()[1]
        except (OSError, OverflowError, UnicodeError) as error:
            expected = "free ports of an address of this machine"
            raise UserError("serve", "--host and ports", f"{each.host}:{each.port} ({error})", expected) from None

    def _on_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log errors that asyncio reports outside any task, such as too many open files."""
        self._say(f"connections: {context.get('exception') or context['message']}")

    async def _disconnect(self) -> None:
        """Stop listening and end all sessions."""
        for each in self.interfaces:
            if each.listening is not None:
                each.listening.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _ask(self, work: Callable[[], Any]) -> Any:
        future: Future[Any] = Future()
        self._work.put((work, future))
        return await asyncio.wrap_future(future)

    async def _connected(
        self, interface: Interface, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        peer = (writer.get_extra_info("peername") or ("?",))[:2]
        connection = Connection(reader, writer, interface.limits, self._ask, ":".join(map(str, peer)))
        if peer[-1] in interface.probes:
            await self._serve(interface, connection)
            return
        if len(interface.clients) >= interface.limits.clients and not self._drop_silent(interface):
            await self._refuse(interface, connection)
            return
        interface.clients.add(connection)
        self._say(f"{connection.name}: connected")
        reason = await self._serve(interface, connection)
        self._say(f"{connection.name}: {reason}")

    async def _serve(self, interface: Interface, connection: Connection) -> str:
        """Serve a connection and close it. Returns the reason why it ended."""
        task, reason = asyncio.current_task(), "left"
        self._tasks.add(task)
        try:
            await interface.handle(connection)
        except TimeoutError:
            reason = "disconnected: it sent nothing, or read no reply, in time"
        except (asyncio.IncompleteReadError, ConnectionError, OSError):
            reason = "gone"
        except asyncio.CancelledError:
            reason = "the server ended"  # only `_disconnect` cancels
        except Dropped as error:
            reason = f"disconnected: {error}"
        except Exception as error:
            reason = f"disconnected: {type(error).__name__}: {error}"
        finally:
            self._tasks.discard(task)
            interface.clients.discard(connection)
            writer = connection.writer
            writer.transport.abort() if reason.startswith("disconnected") else writer.close()
        return reason

    def _drop_silent(self, interface: Interface) -> bool:
        """Close the connection that has been silent longest, among those without any request so far.

        Returns whether a connection was closed.
        """
        now_s = time.monotonic()
        silent = [each for each in interface.clients if not each.has_asked and now_s - each.heard_s >= _GRACE_S]
        if not silent:
            return False
        dropped = min(silent, key=lambda each: each.heard_s)
        interface.clients.discard(dropped)
        dropped.writer.transport.abort()
        self._say(f"{dropped.name}: dropped for another client: no request in {now_s - dropped.heard_s:.0f} s")
        return True

    async def _refuse(self, interface: Interface, connection: Connection) -> None:
        """Tell a client that the limit is reached. With too many such clients, only close the connection."""
        self._say(f"{connection.name}: refused, {interface.limits.clients} clients are connected")
        if interface.n_extra >= interface.limits.clients:
            connection.writer.transport.abort()
            return
        connection.is_extra = True
        connection.limits = replace(interface.limits, message_s=min(interface.limits.message_s, _EXTRA_S))
        interface.n_extra += 1
        try:
            await self._serve(interface, connection)
        finally:
            interface.n_extra -= 1

    def _say(self, text: str) -> None:
        if self._notes is not None:
            self._notes(text)


async def answers(interface: Interface) -> bool:
    """Connect to an interface of this event loop, and return whether it sends its greeting.

    The connection does not count as a client. Raises OSError if it fails, and IncompleteReadError if the interface
    closes it.
    """
    if interface.listening is None or not interface.listening.sockets:
        return False
    listening = interface.listening.sockets[0]
    address = (_own_address(listening), *listening.getsockname()[1:])
    with socket.socket(listening.family) as probe:
        probe.setblocking(False)
        # `_connected` recognises the probe by this port, so it must be stored before the connection is accepted.
        probe.bind((address[0], 0))
        port = probe.getsockname()[1]
        interface.probes.add(port)
        try:
            await asyncio.get_running_loop().sock_connect(probe, address)
            reader, writer = await asyncio.open_connection(sock=probe)
            try:
                return await interface.greets(reader, writer)
            finally:
                writer.close()
        finally:
            interface.probes.discard(port)


def _own_address(listening: Any) -> str:
    """The address by which this machine reaches a listening socket; loopback if it listens on all addresses."""
    host = listening.getsockname()[0]
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


def _answer(work: Callable[[], Any], future: "Future[Any]") -> None:
    """Call `work` and pass its result or error to the thread of the connections; KeyboardInterrupt is also raised."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(work())
    except Exception as error:
        future.set_exception(error)
    except BaseException:
        # Passed on as the result, KeyboardInterrupt would end the event loop with a traceback.
        future.set_exception(ConnectionAbortedError("the server ends"))
        raise
