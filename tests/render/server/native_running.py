"""A server of our own interface alone, in a thread."""

import threading

from perilune_render.server.connection import Limits
from perilune_render.server.grounds import Grounds
from perilune_render.server.native.serve import Native, native_address
from perilune_render.server.serve import Server


class NativeRunning:
    """Answers clients at `address` until `close`."""

    def __init__(self, grounds: Grounds, limits: Limits = Limits(), host: str = "127.0.0.1"):  # noqa: B008
        self.host = host
        self.notes: list[str] = []

        self.native = Native(grounds, limits, self.notes.append)
        self.interface = self.native.interface(host, 0)
        self.server = Server(self.native.interfaces, self.notes.append)
        self.server.begin()
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()

    def __enter__(self) -> "NativeRunning":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        return native_address(self.host, self.interface.port)

    def close(self) -> None:
        self.server.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()
