"""A proxy before an object store that fails one request in twenty and answers another late, by a random seed.

A failed request is answered with 500 or 503, or its connection is closed: before the store has seen it, after the
store has executed it, or in the middle of the answer. The proxy can vanish and come back on the same port.
"""

import asyncio
import collections
import random
import threading
from collections.abc import Coroutine
from types import TracebackType
from typing import Any

import aiohttp
from aiohttp import web

FAULTS = ("500", "503", "closed", "500 after", "closed after", "half an answer")
_OF_ONE_HOP = ("connection", "content-length", "expect", "host", "keep-alive", "transfer-encoding")


class FaultyProxy:
    """The proxy, in a thread. Use as a context manager; clients connect to `address`, as http://127.0.0.1:1234."""

    def __init__(self, store: str, seed: int, fault_share: float = 0.05, late_share: float = 0.05, late_s: float = 2.0):
        self._store, self._draw = store.rstrip("/"), random.Random(seed)
        self._fault_share, self._late_share, self._late_s = fault_share, late_share, late_s
        self.counts: collections.Counter[str] = collections.Counter()
        """Number of requests, by what was done with them: a name of FAULTS, "late" or "passed"."""
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._port = 0

    @property
    def address(self) -> str:
        """Its address."""
        return f"http://127.0.0.1:{self._port}"

    def __enter__(self) -> "FaultyProxy":
        self._thread.start()
        self.come_back()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.vanish()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def vanish(self) -> None:
        """Close all connections and refuse new ones."""
        self._call(self._close())

    def come_back(self) -> None:
        """Answer again, on the same port."""
        self._call(self._open())

    def _call(self, task: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(task, self._loop).result(30)

    async def _open(self) -> None:
        self._session = aiohttp.ClientSession(auto_decompress=False)
        application = web.Application()
        application.router.add_route("*", "/{path:.*}", self._answer)
        self._runner = web.AppRunner(application, shutdown_timeout=0)
        await self._runner.setup()
        site = web.TCPSite(self._runner, "127.0.0.1", self._port, reuse_address=True)
        await site.start()
        self._port = self._runner.addresses[0][1]

    async def _close(self) -> None:
        await self._runner.cleanup()
        await self._session.close()

    async def _answer(self, request: web.Request) -> web.StreamResponse:
        body = await request.content.read()
        drawn = self._draw.random()
        fault = self._draw.choice(FAULTS) if drawn < self._fault_share else ""
        late = self._fault_share <= drawn < self._fault_share + self._late_share
        self.counts[fault or ("late" if late else "passed")] += 1
        if fault in ("500", "503"):
            return web.Response(status=int(fault))
        if fault == "closed":
            return _closed(request)
        if late:
            await asyncio.sleep(self._draw.uniform(0, self._late_s))
        status, headers, content = await self._passed(request, body)
        if fault == "500 after":
            return web.Response(status=500)
        if fault == "closed after":
            return _closed(request)
        if request.method == "HEAD":
            return web.Response(status=status, headers=headers)
        headers.popall("Content-Length", None)
        if fault == "half an answer":
            half = web.StreamResponse(status=status, headers={**headers, "Content-Length": str(len(content))})
            await half.prepare(request)
            await half.write(content[: len(content) // 2])
            return _closed(request)
        return web.Response(status=status, headers=headers, body=content)

    async def _passed(self, request: web.Request, body: bytes) -> tuple[int, Any, bytes]:
        """Let the store answer: status, headers and body."""
        headers = [(name, value) for name, value in request.headers.items() if name.lower() not in _OF_ONE_HOP]
        url = aiohttp.client.URL(f"{self._store}{request.raw_path}", encoded=True)
        async with self._session.request(request.method, url, headers=headers, data=body) as found:
            kept = found.headers.copy()
            for name in ("Connection", "Transfer-Encoding", "Server", "Date"):
                kept.popall(name, None)
            return found.status, kept, await found.read()


def _closed(request: web.Request) -> web.Response:
    """Close the connection without an answer."""
    if request.transport is not None:
        request.transport.abort()
    return web.Response()
