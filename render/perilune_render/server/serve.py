"""The server: many clients, one world. Requests of all clients are answered one after another.

The connections are in an event loop of a second thread; the world, which may be Blender, is in the first. A client
waits for each reply before its next request, so it has at most one request in the queue, and the queue is fair.
"""

import asyncio
import queue
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

from perilune_render.server.notes import Notes
from perilune_shared.errors import UserError

_STOP_S = 5.0
_NOTES_S = 1.0
"""Time for which the end of the server waits for its last notes, seconds."""
_GRACE_S = 1.0
"""Silence before which a client without a request is not dropped in favour of another, seconds."""
_EXTRA_S = 2.0
"""Time within which a client that is one too many must say its hello and read its error, seconds."""
Ask = Callable[[Callable[[], Any]], Awaitable[Any]]
"""Runs a function in the thread of the world and returns its result."""


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


@dataclass
class Server:
    """Accepts clients in a thread of its own; `run` answers their requests in the calling thread."""

    host: str
    port: int
    """Port; 0 takes a free one, which is then found here."""
    handle: Callable[[Connection], Awaitable[None]]
    """Coroutine function that serves one connection until it ends."""
    limits: Limits
    note: Callable[[str], object]
    """Called with a line on what happens, in a thread of its own: it may block."""
    other: Callable[[Ask, Callable[[int], object]], Coroutine[Any, Any, None]] | None = None
    """Coroutine function of another interface in the same loop, called with what `Connection.ask` does and with a
    function that it calls with its port when clients can connect."""
    other_port: int = 0
    """Port of the other interface, once it has begun."""
    _ready: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _work: "queue.Queue[tuple[Callable[[], Any], Future[Any]] | None]" = field(default_factory=queue.Queue)
    _loop: asyncio.AbstractEventLoop | None = None
    _failure: BaseException | None = None
    _tasks: set = field(default_factory=set)
    _clients: set[Connection] = field(default_factory=set)
    _n_extra: int = 0
    _notes: Notes | None = None

    def begin(self) -> None:
        """Accept clients. Raises UserError if the address cannot be used."""
        self._notes = Notes(self.note)
        self._thread = threading.Thread(target=self._accept, name="connections", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def run(self) -> None:
        """Answer requests until `stop` is called."""
        try:
            while (item := self._work.get()) is not None:
                work, future = item
                if future.set_running_or_notify_cancel():
                    try:
                        future.set_result(work())
                    except BaseException as error:
                        future.set_exception(error)
                        if isinstance(error, KeyboardInterrupt):
                            raise
        finally:
            if self._loop is not None:
                self._loop.call_soon_threadsafe(self._loop.stop)
            if self._thread is not None:
                self._thread.join(_STOP_S)
            if self._notes is not None:
                self._notes.close(_NOTES_S)

    def stop(self) -> None:
        """End `run`; may be called from any thread."""
        self._work.put(None)

    def _accept(self) -> None:
        """The thread of the connections."""
        self._loop = loop = asyncio.new_event_loop()
        try:
            started = loop.run_until_complete(asyncio.start_server(self._connected, self.host, self.port))
            self.port = started.sockets[0].getsockname()[1]
            loop.run_until_complete(self._begin_other())
        except OSError as error:
            expected = "free ports of an address of this machine"
            self._failure = UserError("serve", "--host and ports", f"{self.host} ({error})", expected)
            self._ready.set()
            return
        self._ready.set()
        loop.run_forever()
        started.close()
        loop.run_until_complete(self._disconnect())
        loop.close()

    async def _begin_other(self) -> None:
        """Start the other interface and wait until its clients can connect. Raises OSError if they cannot."""
        if self.other is None:
            return
        port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        task = asyncio.ensure_future(self.other(self._ask, port.set_result))
        waited: list[asyncio.Future[Any]] = [task, port]
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            await task
        self.other_port = port.result()
        self._tasks.add(task)

    async def _disconnect(self) -> None:
        """End all sessions."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _ask(self, work: Callable[[], Any]) -> Any:
        future: Future[Any] = Future()
        self._work.put((work, future))
        return await asyncio.wrap_future(future)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = ":".join(map(str, (writer.get_extra_info("peername") or ("?",))[:2]))
        connection = Connection(reader, writer, self.limits, self._ask, name)
        if len(self._clients) >= self.limits.clients and not self._drop_silent():
            await self._refuse(connection)
            return
        self._clients.add(connection)
        self._say(f"{name}: connected")
        reason = await self._serve(connection)
        self._say(f"{name}: {reason}")

    async def _serve(self, connection: Connection) -> str:
        """Serve a connection and close it. Returns why it ended."""
        task, reason = asyncio.current_task(), "left"
        self._tasks.add(task)
        try:
            await self.handle(connection)
        except TimeoutError:
            reason = "disconnected: it sent nothing, or read no reply, in time"
        except (asyncio.IncompleteReadError, ConnectionError, OSError):
            reason = "gone"
        except asyncio.CancelledError:
            reason = "the server ended"  # only `_disconnect` cancels
        except Exception as error:
            reason = f"disconnected: {type(error).__name__}: {error}"
        finally:
            self._tasks.discard(task)
            self._clients.discard(connection)
            writer = connection.writer
            writer.transport.abort() if reason.startswith("disconnected") else writer.close()
        return reason

    def _drop_silent(self) -> bool:
        """Drop the client that has been silent longest, of those that never sent a request. False if there is none."""
        now_s = time.monotonic()
        silent = [each for each in self._clients if not each.has_asked and now_s - each.heard_s >= _GRACE_S]
        if not silent:
            return False
        dropped = min(silent, key=lambda each: each.heard_s)
        self._clients.discard(dropped)
        dropped.writer.transport.abort()
        self._say(f"{dropped.name}: dropped for another client: no request in {now_s - dropped.heard_s:.0f} s")
        return True

    async def _refuse(self, connection: Connection) -> None:
        """Let the interface tell a client that it is one too many; close it at once if there are many of those."""
        self._say(f"{connection.name}: refused, {self.limits.clients} clients are connected")
        if self._n_extra >= self.limits.clients:
            connection.writer.transport.abort()
            return
        connection.is_extra = True
        connection.limits = replace(self.limits, message_s=min(self.limits.message_s, _EXTRA_S))
        self._n_extra += 1
        try:
            await self._serve(connection)
        finally:
            self._n_extra -= 1

    def _say(self, text: str) -> None:
        if self._notes is not None:
            self._notes(text)
