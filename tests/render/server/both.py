"""A server with both interfaces, and the raw bytes of a client of ZeroMQ."""

import socket
import threading

import numpy as np
from tests.render.server.conftest import FIELD_OF_VIEW_DEG, SIZE, Client

from perilune_render.poses.plan import trajectory_seed
from perilune_render.server.connection import Limits
from perilune_render.server.grounds import Grounds
from perilune_render.server.native.serve import Native
from perilune_render.server.pangu.serve import greets, serve_pangu
from perilune_render.server.pangu.session import Session
from perilune_render.server.serve import Interface, Server
from perilune_shared.client import SceneClient
from perilune_shared.geometry.frames import sun_direction

GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00" + b"NULL" + bytes(16) + bytes(32)
READY = b"\x04\x1c\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER"


class Both:
    """A server of both interfaces in a thread."""

    def __init__(self, simulated, limits=Limits(message_s=2.0)):  # noqa: B008
        self.notes: list[str] = []
        fov = float(np.radians(FIELD_OF_VIEW_DEG))
        start = (*SIZE, fov, sun_direction(100, 25), trajectory_seed(simulated.scene.seed, 0))

        async def handle(connection):
            await serve_pangu(connection, lambda: Session(simulated, *start), self.server.stop)

        self.pangu = Interface("PANGU", "127.0.0.1", 0, handle, greets, limits)
        native = Native(Grounds(simulated), limits, self.notes.append, [self.pangu])
        self.native = native.interface("127.0.0.1", 0)
        self.server = Server(native.interfaces, self.notes.append)
        self.server.begin()
        self.failure: BaseException | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.server.run()
        except BaseException as error:
            self.failure = error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.native.port}"

    def connected(self, interface: str) -> socket.socket:
        """A connection without a byte to the interface `pangu` or `native`."""
        return socket.create_connection(("127.0.0.1", getattr(self, interface).port), timeout=20)

    def check(self) -> None:
        """Fail unless valid clients of both interfaces are answered."""
        with SceneClient(self.address, timeout_s=20) as scene:
            assert scene.health() == {
                "PANGU": f"127.0.0.1:{self.pangu.port}",
                "perilune_shared.client": f"127.0.0.1:{self.native.port}",
            }
        with Client(self.pangu.port) as client:
            client.send("00000001")
            client.image()
