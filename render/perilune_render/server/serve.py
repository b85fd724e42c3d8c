"""The server: many clients, one world. Requests of all clients are answered one after another.

The connections are in an event loop of a second thread; the world, which may be Blender, is in the first. A client
waits for each reply before its next request, so it has at most one request in the queue, and the queue is fair.
"""

import asyncio
import queue
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from perilune_shared.errors import UserError

_STOP_S = 5.0
Ask = Callable[[Callable[[], Any]], Awaitable[Any]]
"""Runs a function in the thread of the world and returns its result."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What one client may ask for."""

    clients: int = 16
    """Largest number of clients at once."""
    idle_s: float = 600.0
    """Time after which a client that sends nothing is disconnected, seconds."""
    message_s: float = 30.0
    """Time within which a begun message must be complete, and a reply read, seconds."""
    items: int = 100_000
    """Largest number of items of an array in a message."""
    item_bytes: int = 4_000_000
    """Largest size of an array in a message, bytes."""


@dataclass
class Connection:
    """One client."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    limits: Limits
    ask: Ask
    """Runs a function in the thread of the world."""
    name: str = ""
    """Address of the client, for messages."""

    async def first(self, n_bytes: int) -> bytes:
        """The first bytes of a message. Raises TimeoutError after `limits.idle_s`."""
        return await asyncio.wait_for(self.reader.readexactly(n_bytes), self.limits.idle_s)

    async def rest(self, n_bytes: int) -> bytes:
        """More bytes of a message that has begun. Raises TimeoutError after `limits.message_s`."""
        if n_bytes == 0:
            return b""
        return await asyncio.wait_for(self.reader.readexactly(n_bytes), self.limits.message_s)

    async def send(self, data: bytes) -> None:
        """Send a reply in one write. Raises TimeoutError if the client does not read it in `limits.message_s`."""
        self.writer.write(data)
        await asyncio.wait_for(self.writer.drain(), self.limits.message_s)


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
    """Called with a line on what happens."""
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
    _n_clients: int = 0

    def begin(self) -> None:
        """Accept clients. Raises UserError if the address cannot be used."""
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
        task = asyncio.current_task()
        self._tasks.add(task)
        name = ":".join(map(str, (writer.get_extra_info("peername") or ("?",))[:2]))
        if self._n_clients >= self.limits.clients:
            self.note(f"{name}: refused, {self.limits.clients} clients are connected")
            writer.close()
            self._tasks.discard(task)
            return
        self._n_clients += 1
        self.note(f"{name}: connected")
        reason = "left"
        try:
            await self.handle(Connection(reader, writer, self.limits, self._ask, name))
        except TimeoutError:
            reason = "disconnected: it sent nothing, or read no reply, in time"
        except (asyncio.IncompleteReadError, ConnectionError, OSError):
            reason = "gone"
        except Exception as error:
            reason = f"disconnected: {type(error).__name__}: {error}"
        finally:
            self._n_clients -= 1
            self._tasks.discard(task)
            self.note(f"{name}: {reason}")
            writer.transport.abort() if reason.startswith("disconnected") else writer.close()
