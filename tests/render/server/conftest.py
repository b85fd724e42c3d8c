"""A server over a small scene, and a client that sends raw bytes."""

import socket
import threading

import numpy as np
import pytest
from tests.helpers.scenes import config_with

from perilune_render.config.dataset import CameraConfig, RenderConfig
from perilune_render.config.scene import SceneConfig, ViewConfig
from perilune_render.config.terrain import TerrainConfig
from perilune_render.flight.lens import camera_of
from perilune_render.flight.view import scene_view
from perilune_render.poses.plan import scene_seed, trajectory_seed
from perilune_render.server.connection import Limits
from perilune_render.server.pangu.serve import greets, serve_pangu
from perilune_render.server.pangu.session import Conventions, Session
from perilune_render.server.serve import Interface, Server
from perilune_render.server.simulation import SimulatedScene
from perilune_render.terrain.scene import grow_scene
from perilune_shared.geometry.frames import sun_direction

SIZE = (64, 48)
FIELD_OF_VIEW_DEG = 40.0


@pytest.fixture(scope="session")
def simulated():
    views = (ViewConfig(height_m=150, reach_m=200), ViewConfig(height_m=1000, reach_m=500))
    config = config_with(
        camera=CameraConfig(width_px=SIZE[0], height_px=SIZE[1], horizontal_fov_deg=FIELD_OF_VIEW_DEG),
        terrain=TerrainConfig(spacing_px=2.0),
        render=RenderConfig(engine="heightfield", samples=1, threads=1),
        scene=SceneConfig(sun_azimuth_deg=100, sun_elevation_deg=25, views=views),
    )
    pinhole = camera_of(config.camera)
    with SimulatedScene(grow_scene(config, scene_view(config.scene, pinhole), scene_seed(config)), config) as simulated:
        simulated.prepare()  # kernels are compiled here, not while a client waits
        yield simulated


class Client:
    """A connection that sends and reads bytes, without an encoder."""

    def __init__(self, port: int, hello: str | None = "00000114"):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        if hello is not None:
            self.send(hello)
            assert self.read(4) == b"\0\0\0\0"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, text: str) -> None:
        self.socket.sendall(bytes.fromhex(text.replace(" ", "")))

    def read(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            part = self.socket.recv(n - len(data))
            if not part:
                raise ConnectionError(f"closed after {len(data)} of {n} bytes")
            data += part
        return data

    def number(self) -> int:
        return int.from_bytes(self.read(4), "big")

    def image(self) -> np.ndarray:
        assert self.number() == 2
        data = self.read(self.number())
        head = b"P6\n64 48 255\n"
        assert data.startswith(head)
        return np.frombuffer(data[len(head) :], np.uint8).reshape(SIZE[1], SIZE[0], 3)

    def error(self) -> str:
        assert self.number() == 1
        self.read(4)
        text = self.read(int.from_bytes(self.read(2), "big"))
        assert text.endswith(b"\0")
        assert len(text) % 2 == 0
        return text.rstrip(b"\0").decode()

    def is_closed(self) -> bool:
        return self.socket.recv(1) == b""


class Running:
    """A server in a thread."""

    def __init__(self, simulated, limits=Limits(message_s=2.0), conventions=Conventions(), note=None):  # noqa: B008
        self.notes: list[str] = []
        start = (
            *SIZE,
            float(np.radians(FIELD_OF_VIEW_DEG)),
            sun_direction(100, 25),
            trajectory_seed(simulated.scene.seed, 0),
        )

        async def handle(connection):
            await serve_pangu(connection, lambda: Session(simulated, *start, conventions), self.server.stop)

        self.interface = Interface("PANGU", "127.0.0.1", 0, handle, greets, limits)
        self.server = Server([self.interface], note or self.notes.append)
        self.server.begin()
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()

    def client(self, hello: str | None = "00000114") -> Client:
        return Client(self.interface.port, hello)


@pytest.fixture(scope="session")
def server(simulated):
    with Running(simulated) as running:
        yield running


@pytest.fixture
def client(server):
    with server.client() as client:
        yield client
