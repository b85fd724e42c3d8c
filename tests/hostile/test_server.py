"""Hostile clients of the image server: its memory stays bounded, and valid clients are answered."""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
import yaml

from perilune_shared.client import SceneClient
from tests.hostile.measured import MEASURED
from tests.render.server.both import GREETING, READY

_SETTINGS = {
    "camera": {"width_px": 64, "height_px": 64, "horizontal_fov_deg": 40.0},
    "terrain": {"spacing_px": 4.0},
    "render": {"samples": 1, "engine": "heightfield", "threads": 1},
    "scene": {"views": [{"height_m": 300, "reach_m": 400}]},
}
PART = bytes(4_000_000)
MOST_GROWN_MB = 250
"""16 clients hold a part of 4 MB each, twice while it is handed over."""


class Served:
    """`perilune-render serve` in a process of its own."""

    def __init__(self, folder: Path):
        path = folder / "scene.yaml"
        path.write_text(yaml.safe_dump({"dataset": _SETTINGS}))
        program = Path(sys.executable).parent / "perilune-render"
        command = [str(program), "serve", "--preset", "tiny", "--scene", str(path), "--port", "0", "--native-port", "0"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        printed = ""
        for line in self.process.stderr:
            printed += line
            if found := re.search(r"PANGU protocol .*?:(\d+),", line):
                self.pangu = int(found[1])
            if found := re.search(r"perilune_shared\.client at (tcp://\S+:(\d+))", line):
                self.address, self.native = found[1], int(found[2])
                break
        else:
            pytest.fail(printed)
        self.started_mb = self.memory_mb()
        self.peak_mb = 0.0
        threading.Thread(target=self.process.stderr.read, daemon=True).start()  # the pipe must not fill

    def memory_mb(self) -> float:
        return psutil.Process(self.process.pid).memory_info().rss / 2**20

    def check(self) -> None:
        """Fail unless both interfaces answer within bounded memory."""
        with SceneClient(self.address, timeout_s=60) as scene:
            assert len(scene.health()) == 2
        self.note_memory()
        assert self.peak_mb <= MOST_GROWN_MB

    def note_memory(self) -> None:
        self.peak_mb = max(self.peak_mb, self.memory_mb() - self.started_mb)

    def connected(self, port: int) -> socket.socket:
        return socket.create_connection(("127.0.0.1", port), timeout=20)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    running = Served(tmp_path_factory.mktemp("served"))
    yield running
    running.process.kill()
    running.process.wait()


@contextlib.contextmanager
def logged(served: Served, name: str):
    """Add the peak of the server's memory to the log of hostile inputs."""
    served.peak_mb, start = 0.0, time.monotonic()
    yield
    if MEASURED in os.environ:
        row = {"name": name, "memory_mb": served.peak_mb, "seconds": time.monotonic() - start}
        with Path(os.environ[MEASURED]).open("a", encoding="utf-8") as log:
            log.write(json.dumps(row) + "\n")


def test_500_parts_of_4_mb_are_not_kept(served):
    head = b"\x03" + len(PART).to_bytes(8, "big")
    with logged(served, "500 parts of 4 MB"), served.connected(served.native) as connection:
        connection.sendall(GREETING + READY)
        for _ in range(499):
            connection.sendall(head)
            connection.sendall(PART)
            served.note_memory()
        served.check()  # while the message is not complete
        connection.sendall(b"\x00\x00")
        reply = b""
        while b"expected an empty one and JSON" not in reply:
            part = connection.recv(1 << 16)
            assert part, reply
            reply += part
        assert b"got 500 parts" in reply
        served.check()


def test_many_messages_that_are_never_completed_are_bounded(served):
    with logged(served, "4 MB from each of 400 clients"), contextlib.ExitStack() as stack:
        for _ in range(400):
            connection = stack.enter_context(served.connected(served.native))
            with contextlib.suppress(OSError):  # one too many is closed
                connection.sendall(GREETING + READY + b"\x02" + len(PART).to_bytes(8, "big") + PART[:-1])
            served.note_memory()
        served.check()


def test_many_arrays_that_are_never_completed_are_bounded(served):
    elevations = bytes.fromhex("00000114 00000003") + (100_000).to_bytes(4, "big")
    with logged(served, "arrays from 200 clients of PANGU"), contextlib.ExitStack() as stack:
        for _ in range(200):
            connection = stack.enter_context(served.connected(served.pangu))
            with contextlib.suppress(OSError):
                connection.sendall(elevations + PART[:700_000])
            served.note_memory()
        served.check()


def test_a_flood_of_connections_is_bounded(served):
    with logged(served, "3000 connections"):
        for n in range(3000):
            with contextlib.suppress(OSError), served.connected((served.native, served.pangu)[n % 2]) as connection:
                connection.sendall(GREETING[: n % 64])
            served.note_memory()
        served.check()
