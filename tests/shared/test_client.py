"""The client of the image server against a server of this test: retries, indices, replies that fit no request."""

import json
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError

zmq = pytest.importorskip("zmq", reason="needs the extra `client`")

DOWN = (0.0, 1.0, 0.0, 0.0)
IMAGE = [b'{"arrays": [{"name": "image", "dtype": "|u1", "shape": [1, 2]}]}', b"\1\2"]
BUSY = [b'{"error": "16 clients are connected; try again", "busy": true}']
REFUSED = [b'{"error": "camera: position: below the surface"}']


class Fake:
    """Sends these replies, the last one again and again; an empty one is not sent. Keeps the requests."""

    def __init__(self, *replies):
        self.requests = []
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self.address = f"tcp://127.0.0.1:{self._socket.bind_to_random_port('tcp://127.0.0.1')}"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(list(replies),))
        self._thread.start()

    def _run(self, replies):
        while not self._ended.is_set():
            if self._socket.poll(50):
                client, empty, content = self._socket.recv_multipart()
                self.requests.append(json.loads(content))
                reply = replies.pop(0) if len(replies) > 1 else replies[0]
                if reply:
                    self._socket.send_multipart([client, empty, *reply])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()
        self._socket.close(0)
        self._context.term()

    @property
    def indices(self):
        return [request["index"] for request in self.requests]


def test_a_busy_server_is_asked_again():
    with Fake(BUSY, BUSY, IMAGE) as server, SceneClient(server.address, timeout_s=20) as client:
        np.testing.assert_array_equal(client.frame((0, 0, 500), DOWN).image, [[1, 2]])
        assert server.indices == [0, 0, 0]


def test_a_server_that_stays_busy_is_an_error_in_time():
    start = time.monotonic()
    with Fake(BUSY) as server, SceneClient(server.address, timeout_s=0.5) as client:
        with pytest.raises(UserError, match="16 clients are connected"):
            client.ground(1, wait=False)
        assert len(server.requests) > 1
    assert time.monotonic() - start < 5


def test_only_frames_that_were_received_have_an_index():
    with Fake(IMAGE, REFUSED, IMAGE, [], IMAGE, IMAGE) as server, SceneClient(server.address, timeout_s=1) as client:
        client.frame((0, 0, 500), DOWN)
        with pytest.raises(UserError, match="below the surface"):
            client.frame((0, 0, -5), DOWN)
        client.frame((0, 0, 500), DOWN)
        with pytest.raises(UserError, match="none in 1 s"):
            client.frame((0, 0, 500), DOWN)
        client.frame((0, 0, 500), DOWN, index=70)
        client.frame((0, 0, 500), DOWN)
        assert server.indices == [0, 1, 1, 2, 70, 2]


def test_fields_that_are_not_given_are_not_sent():
    with Fake(IMAGE) as server, SceneClient(server.address) as client:
        client.frame((0, 0, 500), DOWN)
        client.frame((0, 0, 500), DOWN, angular_velocity_radps=(0.1, 0, 0), sun_deg=(90, 20))
        plain, full = server.requests
    assert not {"angular_velocity_radps", "sun_deg", "scene"} & set(plain)
    assert (full["angular_velocity_radps"], full["sun_deg"]) == ([0.1, 0.0, 0.0], [90.0, 20.0])


def test_a_frame_without_an_image_is_an_error_and_has_no_index():
    with Fake([b'{"arrays": []}'], IMAGE) as server, SceneClient(server.address) as client:
        with pytest.raises(UserError, match="image"):
            client.frame((0, 0, 500), DOWN)
        client.frame((0, 0, 500), DOWN)
        assert server.indices == [0, 0]


def test_a_refused_address_leaves_nothing_that_blocks():
    """A garbage collection would wait forever for a context whose socket is still open."""
    code = """
import gc
from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError
try:
    SceneClient("nowhere")
except UserError as error:
    error.cycle = error
gc.collect()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
