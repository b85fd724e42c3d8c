"""The image server: frames per second over the sockets, and memory over many frames. Writes runs/bench/serve.json.

A client in another process asks for frames of a descent, one after another, by PANGU's protocol and by our own.
"""

import argparse
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from benchmarks.figures import write_figures
from perilune_render.server.pangu.messages import IMAGE, VERSION
from perilune_render.server.pangu.wire import double_bytes, unsigned
from perilune_shared.client import SceneClient
from perilune_shared.config.yaml_text import to_yaml_text

SCENE = {
    "name": "bench-serve",
    "render": {"samples": 2},
    "scene": {
        "sun_elevation_deg": 20,
        "views": [{"height_m": 180, "reach_m": 300}, {"height_m": 1500, "reach_m": 1300}],
    },
}
"""The ground of a descent of `small`, two samples."""
CASES = (("heightfield", 256, 40), ("cycles", 256, 20), ("heightfield", 1024, 8), ("cycles", 1024, 4))
"""Engine, width of the frames, pixels, and number of frames."""
N_FLIGHTS = 5
"""Flights of each interface whose frames are timed."""
DOWNWARD = (0.0, 1.0, 0.0, 0.0)
"""Attitude of a camera that looks straight down, for our own interface."""
_SETTLED = 2000
"""Frames after which memory is compared: caches and threads are then in place."""


def descent(n: int) -> np.ndarray:
    """Positions (n, 3) along a descent, metres."""
    z = np.linspace(1400, 200, n)
    return np.stack([0 * z, -0.3 * (z - 200), z], axis=1)


class Pangu:
    """A client of PANGU's protocol."""

    def __init__(self, port: int):
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket.sendall(unsigned(VERSION))
        self._read(4)

    def _read(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            part = self.socket.recv(n - len(data))
            if not part:
                raise ConnectionError("the server closed the connection")
            data += part
        return data

    def frame(self, place: np.ndarray) -> None:
        """Ask for the image of a camera that looks straight down."""
        self.socket.sendall(unsigned(16) + double_bytes([*place, 0.0, -90.0, 0.0]))
        if int.from_bytes(self._read(4), "big") != IMAGE:
            raise RuntimeError("no image")
        self._read(int.from_bytes(self._read(4), "big"))


def seconds(interfaces: dict[str, Callable[[np.ndarray], object]], n: int) -> dict[str, float]:
    """Median time of a frame by each interface, seconds.

    The interfaces take turns, flight by flight: what else the machine does then slows all of them alike. The first
    flight pays for the engine and its horizon, and is not counted.
    """
    places = descent(n)
    times: dict[str, list[float]] = {name: [] for name in interfaces}
    for flight in range(1 + N_FLIGHTS):
        for name, ask in interfaces.items():
            for place in places:
                start = time.perf_counter()
                ask(place)
                if flight > 0:
                    times[name].append(time.perf_counter() - start)
    return {name: float(np.median(part)) for name, part in times.items()}


class Served:
    """A server in a process of its own."""

    def __init__(self, width_px: int, engine: str):
        self.folder = tempfile.TemporaryDirectory()
        path = Path(self.folder.name) / "scene.yaml"
        camera = {"width_px": width_px, "height_px": width_px}
        path.write_text(to_yaml_text({"dataset": {**SCENE, "camera": camera}}))
        command = [str(Path(sys.executable).parent / "perilune-render"), "serve", "--scene", str(path)]
        command += ["--engine", engine, "--port", "0", "--native-port", "0"]
        # Ground that a wider camera sees finer would be another scene: keep the vertices of 256 pixels.
        command += ["--set", f"dataset.terrain.spacing_px={0.5 * width_px / 256}"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.port = int(self._line(r"PANGU protocol .*?:(\d+),"))
        self.native = self._line(r"perilune_shared\.client at (tcp://\S+)")

    def _line(self, pattern: str) -> str:
        """The first group of a pattern in what the server prints."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            found = re.search(pattern, line)
            if found:
                return found[1]
        raise RuntimeError("the server did not start")

    def __enter__(self) -> "Served":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(20)
        self.folder.cleanup()

    def megabytes(self) -> float:
        """Resident memory of the server."""
        return psutil.Process(self.process.pid).memory_info().rss / 1e6


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=20_000)
    given = parser.parse_args()
    figures: dict[str, object] = {}
    for engine, width, n in CASES:
        with Served(width, engine) as server:
            with SceneClient(server.native) as scene:
                pangu = Pangu(server.port).frame
                found = seconds({"pangu": pangu, "own": partial(scene.frame, rotation_wxyz=DOWNWARD)}, n)
            figures |= {f"{engine}_{width}_{interface}_s": time_s for interface, time_s in found.items()}
    with Served(32, "heightfield") as server:
        client = Pangu(server.port)
        places = descent(given.frames)
        start = time.perf_counter()
        for n, place in enumerate(places):
            client.frame(place)
            if n == min(_SETTLED, given.frames // 2):
                settled = server.megabytes()
        figures |= {
            "memory_frames": given.frames,
            "memory_frames_per_s": given.frames / (time.perf_counter() - start),
            "memory_settled_mb": settled,
            "memory_grown_mb": server.megabytes() - settled,
        }
    write_figures(Path("runs/bench/serve.json"), figures)


if __name__ == "__main__":
    main()
