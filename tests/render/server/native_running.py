"""A server of our own interface alone, in a thread."""

import threading

from perilune_render.server.grounds import Grounds
from perilune_render.server.native_serve import native_address, serve_native
from perilune_render.server.serve import Limits, Server


class NativeRunning:
    """Answers clients at `address` until `close`."""

    def __init__(self, grounds: Grounds, limits: Limits = Limits(), host: str = "127.0.0.1"):  # noqa: B008
        self.host = host
        self.notes: list[str] = []

        async def refuse(connection):
            connection.writer.close()

        async def other(ask, ready):
            await serve_native(native_address(host, 0), grounds, ask, ready, limits, self.notes.append)

        self.server = Server(host, 0, refuse, limits, self.notes.append, other)
        self.server.begin()
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()

    def __enter__(self) -> "NativeRunning":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        return native_address(self.host, self.server.other_port)

    def close(self) -> None:
        self.server.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()
