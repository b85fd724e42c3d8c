"""Clients of our own interface that do not read, send too much or are too many hold up nobody."""

import json
import socket
import threading
import time
from contextlib import contextmanager

import pytest
import zmq
from tests.render.server.native_running import NativeRunning

from perilune_render.server.connection import Limits
from perilune_render.server.grounds import Grounds
from perilune_render.server.native import serve, zmtp
from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError

DOWN = (0.0, 1.0, 0.0, 0.0)
SCENE = b'{"request": "scene"}'


@contextmanager
def dealers(address, n, **options):
    """Sockets that may send any number of messages before a reply."""
    with zmq.Context() as context:
        sockets = [context.socket(zmq.DEALER) for _ in range(n)]
        for socket in sockets:
            socket.setsockopt(zmq.LINGER, 0)
            for name, value in options.items():
                socket.setsockopt(getattr(zmq, name), value)
            socket.connect(address)
        try:
            yield sockets
        finally:
            for socket in sockets:
                socket.close()


def reply_of(socket, parts):
    socket.send_multipart(parts)
    assert socket.poll(5000)
    return socket.recv_multipart()


def until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_client_that_does_not_read_is_disconnected_and_holds_up_nobody(simulated, monkeypatch):
    monkeypatch.setattr(serve, "answer", lambda grounds, content, client: [b"{}", bytes(2_000_000)])
    with (
        NativeRunning(Grounds(simulated), Limits(message_s=1.0)) as running,
        dealers(running.address, 1, RCVHWM=1, RCVBUF=100_000) as (slow,),
        dealers(running.address, 1) as (good,),
    ):
        for _ in range(60):
            slow.send(SCENE)
        for _ in range(5):
            assert len(reply_of(good, [b"", SCENE])[-1]) == 2_000_000
        until(lambda: any("read no reply, in time" in note for note in running.notes))


def test_requests_before_the_reply_are_answered_in_order(simulated, monkeypatch):
    monkeypatch.setattr(serve, "answer", lambda grounds, content, client: [content])
    with NativeRunning(Grounds(simulated)) as running, dealers(running.address, 1) as (hasty,):
        for n in range(200):
            hasty.send_multipart([b"", str(n).encode()])
        for n in range(200):
            assert hasty.poll(5000)
            assert hasty.recv_multipart() == [b"", str(n).encode()]


@pytest.mark.parametrize(
    "parts",
    [
        [b"", SCENE, b""],
        [b"", SCENE, bytes(1000)],
        [b"id", b"", SCENE],
        [b"", b"", SCENE],
        [SCENE, SCENE],
        [b""] * 1000,
        [bytes(100_000)] * 50,
    ],
)
def test_messages_of_more_parts_are_refused_and_not_sent_back(simulated, parts):
    with NativeRunning(Grounds(simulated)) as running, dealers(running.address, 1) as (socket,):
        *envelope, reply = reply_of(socket, parts)
        assert f"got {len(parts)} parts" in json.loads(reply)["error"]
        assert envelope == ([b""] if parts[0] == b"" else [])
        assert json.loads(reply_of(socket, [b"", SCENE])[-1])["n_scenes"] == 1


def test_a_request_above_the_largest_size_ends_that_connection_alone(simulated):
    with (
        NativeRunning(Grounds(simulated)) as running,
        dealers(running.address, 1) as (socket,),
        SceneClient(running.address) as good,
    ):
        socket.send(bytes(zmtp.LARGEST_REQUEST_BYTES + 1))
        assert not socket.poll(500)
        assert good.scene().n_scenes == 1
        assert json.loads(reply_of(socket, [SCENE])[-1])["n_scenes"] == 1  # connected again


def test_clients_above_the_limit_are_served_once_another_left(simulated):
    with NativeRunning(Grounds(simulated), Limits(clients=3)) as running:
        with dealers(running.address, 64) as sockets:
            for socket in sockets:
                socket.send(SCENE)
            heads = []
            for socket in sockets:
                assert socket.poll(5000)
                heads.append(json.loads(socket.recv_multipart()[-1]))
            assert sum("error" not in head for head in heads) == 3
            assert all("3 clients are connected" in head["error"] for head in heads if head.get("busy"))
            with SceneClient(running.address, timeout_s=5) as late:
                assert late.health()
            with SceneClient(running.address, timeout_s=0.5) as late, pytest.raises(UserError, match="3 clients are"):
                late.scene()
            with SceneClient(running.address, timeout_s=20) as patient:
                found = []
                thread = threading.Thread(target=lambda: found.append(patient.frame((0, 0, 500), DOWN)))
                thread.start()
                thread.join(0.5)
                assert not found
                for socket in sockets:
                    socket.close()
                thread.join(20)
                assert found[0].image.shape == (48, 64)
        # Clients that come and go take no places.
        for _ in range(10):
            with SceneClient(running.address, timeout_s=5) as client:
                assert client.scene().n_scenes == 1


def test_a_place_is_freed_by_idling(simulated):
    with (
        NativeRunning(Grounds(simulated), Limits(clients=1, idle_s=1.0)) as running,
        SceneClient(running.address) as idle,
        SceneClient(running.address, timeout_s=20) as other,
    ):
        assert idle.scene().n_scenes == 1
        start = time.monotonic()
        assert other.scene().n_scenes == 1  # asks again until then
        assert time.monotonic() - start > 0.5
        until(lambda: not running.native._admitted)
        assert idle.scene().n_scenes == 1  # connected again


def test_a_full_queue_of_scenes_is_a_reason_to_ask_again(simulated, monkeypatch):
    monkeypatch.setattr("perilune_render.server.grounds.MAX_WAITING", 1)
    begin = threading.Event()
    grown = Grounds._new_scene

    def slow(self, number):
        begin.wait(20)
        return grown(self, number)

    monkeypatch.setattr(Grounds, "_new_scene", slow)
    grounds = Grounds(simulated, 5)
    with (
        NativeRunning(grounds) as running,
        SceneClient(running.address) as first,
        SceneClient(running.address) as second,
    ):
        assert first.ground(1, wait=False) is None
        assert second.ground(2, wait=False) is None
        assert list(grounds._waiting) == [1]
        begin.set()
        assert second.frame((0, 0, 500), DOWN, scene=2).image.shape == (48, 64)


def test_an_error_of_the_server_is_noted(simulated, monkeypatch):
    monkeypatch.setattr(serve, "answer", lambda *_: 1 / 0)
    with NativeRunning(Grounds(simulated)) as running:
        with SceneClient(running.address) as client, pytest.raises(UserError, match="ZeroDivisionError"):
            client.scene()
        assert "perilune_shared.client: ZeroDivisionError: division by zero" in running.notes


def test_an_address_of_ip_version_6(simulated):
    with socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
    with NativeRunning(Grounds(simulated), host="::1") as running, SceneClient(running.address) as client:
        assert running.address.startswith("tcp://[::1]:")
        assert client.scene().camera.width_px == 64
