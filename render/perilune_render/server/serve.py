"""The server: many clients, one world. Requests of all clients are answered one after another.

The connections of all interfaces are in an event loop of a second thread; the world, which may be Blender, is in the
first. A connection is read again when its request is answered, so it has at most one request in the queue, and the
queue is fair. If the second thread ends for any reason but `stop`, `run` raises an error.
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

from perilune_render.server.notes import Notes
from perilune_shared.errors import UserError

_STOP_S = 5.0
_WATCH_S = 1.0
"""Time between two looks whether the ports are listened to, seconds."""
_NOTES_S = 1.0
"""Time for which the end of the server waits for its last notes, seconds."""
_GRACE_S = 1.0
"""Silence before which a client without a request is not dropped in favour of another, seconds."""
_EXTRA_S = 2.0
"""Time within which a client that is one too many must say its hello and read its error, seconds."""
Ask = Callable[[Callable[[], Any]], Awaitable[Any]]
"""Runs a function in the thread of the world and returns its result."""


class Dropped(Exception):
    """Ends a connection; the text says why."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one client may ask for."""

    clients: int = 16
    """Largest number of clients at once."""
    idle_s: float = 600.0
    """Time after which a client that sends nothing between two messages is disconnected, seconds."""
    message_s: float = 30.0
    """Time within which the hello must come, a begun message be complete, and a reply be read, seconds."""
    items: int = 100_000
    """Largest number of items of an array in a message."""
    item_bytes: int = 4_000_000
    """Largest size of an array in a message, bytes."""


@dataclass(eq=False)
class Connection:
    """One client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    limits: Limits
    ask: Ask
    """Runs a function in the thread of the world."""
    name: str = ""
    """Address of the client, for messages."""
    is_extra: bool = False
    """Whether the largest number of clients is connected already: this one gets an error."""
    has_asked: bool = False
    """Whether it ever sent a whole request."""
    heard_s: float = field(default_factory=time.monotonic)
    """When it connected or last sent something, by `time.monotonic`."""
    _due_s: float = 0.0
    """When the present message must be complete, by `time.monotonic`."""

    async def hello(self, n_bytes: int) -> bytes:
        """The bytes that a client sends first. Raises TimeoutError after `limits.message_s`."""
        self._due_s = time.monotonic() + self.limits.message_s
        return await self.rest(n_bytes)

    async def first(self, n_bytes: int) -> bytes:
        """The first bytes of a message. Raises TimeoutError after `limits.idle_s`, and if they come in part only."""
        async with asyncio.timeout(self.limits.idle_s):
            begun = await self.reader.readexactly(1)
        self._due_s = time.monotonic() + self.limits.message_s
        return begun + await self.rest(n_bytes - 1)

    async def rest(self, n_bytes: int) -> bytes:
        """More bytes of a message. Raises TimeoutError `limits.message_s` after the message began."""
        async with asyncio.timeout(self._due_s - time.monotonic()):
            data = await self.reader.readexactly(n_bytes)
        self.heard_s = time.monotonic()
        return data

    async def send(self, data: bytes) -> None:
        """Send a reply in one write. Raises TimeoutError if the client does not read it in `limits.message_s`."""
        self.writer.write(data)
        # Not `wait_for`, which in Python 3.11 loses a cancellation that comes as it ends.
        async with asyncio.timeout(self.limits.message_s):
            await self.writer.drain()


@dataclass(eq=False)
class Interface:
    """One port, and how its clients are served."""

    name: str
    """Name of the protocol, for messages."""
    host: str
    """Address to listen on."""
    port: int
    """Port; 0 takes a free one, which is then found here."""
    handle: Callable[[Connection], Awaitable[None]]
    """Coroutine function that serves one connection until it ends. May raise `Dropped`."""
    greets: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[bool]]
    """Whether the other end of a new connection greets as this interface does."""
    limits: Limits
    """What each client may ask for."""
    clients: set[Connection] = field(default_factory=set)
    """The connections, without those that are one too many."""
    probes: set[int] = field(default_factory=set)
    """Ports from which the server itself connects to see that the interface answers."""
    n_extra: int = 0
    """Number of connections that are one too many."""
    listening: asyncio.Server | None = None
    """Accepts connections, once the server has begun."""


@dataclass
class Server:
    """Accepts clients in a thread of its own; `run` answers their requests in the calling thread."""

    interfaces: list[Interface]
    note: Callable[[str], object]
    """Called with a line on what happens, in a thread of its own: it may block."""
    _ready: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _work: "queue.Queue[tuple[Callable[[], Any], Future[Any]] | None]" = field(default_factory=queue.Queue)
    _loop: asyncio.AbstractEventLoop | None = None
    _failure: BaseException | None = None
    _ending: asyncio.Event = field(default_factory=asyncio.Event)
    _tasks: set = field(default_factory=set)
    _notes: Notes | None = None

    def begin(self) -> None:
        """Accept clients. Raises UserError if an address cannot be used."""
        self._notes = Notes(self.note)
        self._thread = threading.Thread(target=self._accept, name="connections", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def run(self) -> None:
        """Answer requests until `stop` is called. Raises UserError if the connections ended before that."""
        try:
            while (item := self._work.get()) is not None:
                _answer(*item)
        finally:
            if self._loop is not None:
                with contextlib.suppress(RuntimeError):  # closed already
                    self._loop.call_soon_threadsafe(self._ending.set)
            if self._thread is not None:
                self._thread.join(_STOP_S)
            if self._notes is not None:
                self._notes.close(_NOTES_S)
        if self._failure is not None:
            found = f"ended by {type(self._failure).__name__}: {self._failure}"
            raise UserError("serve", "connections", found, "a server that answers; start it again") from self._failure

    def stop(self) -> None:
        """End `run`; may be called from any thread."""
        self._work.put(None)

    def _accept(self) -> None:
        """The thread of the connections. However it ends, `run` ends too."""
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
        """Wait for the end. Raises RuntimeError if a port is not listened to any more."""
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
        """Note what asyncio reports outside of all tasks, such as too many open files."""
        self._say(f"connections: {context.get('exception') or context['message']}")

    async def _disconnect(self) -> None:
        """Stop to listen and end all sessions."""
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
        """Serve a connection and close it. Returns why it ended."""
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
        """Drop the client that has been silent longest, of those that never sent a request. False if there is none."""
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
        """Let the interface tell a client that it is one too many; close it at once if there are many of those."""
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
    """Whether a new connection to an interface of this event loop is greeted, beside its limit of clients.

    Raises OSError if it cannot be connected to, and IncompleteReadError if it closes the connection.
    """
    if interface.listening is None or not interface.listening.sockets:
        return False
    listening = interface.listening.sockets[0]
    place = (_own_address(listening), *listening.getsockname()[1:])
    with socket.socket(listening.family) as own:
        own.setblocking(False)
        # The port must be known before the connection is accepted.
        own.bind((place[0], 0))
        port = own.getsockname()[1]
        interface.probes.add(port)
        try:
            await asyncio.get_running_loop().sock_connect(own, place)
            reader, writer = await asyncio.open_connection(sock=own)
            try:
                return await interface.greets(reader, writer)
            finally:
                writer.close()
        finally:
            interface.probes.discard(port)


def _own_address(listening: Any) -> str:
    """The address at which this machine reaches a listening socket: one that listens on all is reached at loopback."""
    host = listening.getsockname()[0]
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


def _answer(work: Callable[[], Any], future: "Future[Any]") -> None:
    """Call `work` and pass its result or error to the thread of the connections. Raises KeyboardInterrupt."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(work())
    except Exception as error:
        future.set_exception(error)
    except BaseException:
        # KeyboardInterrupt would end the event loop with a traceback.
        future.set_exception(ConnectionAbortedError("the server ends"))
        raise
