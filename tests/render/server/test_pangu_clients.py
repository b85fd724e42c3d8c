"""Sessions of PANGU's clients: versions, limits, several at once."""

import threading
import time

import pytest
from tests.render.server.conftest import Running

from perilune_render.server.pangu_session import Conventions
from perilune_render.server.serve import Limits


def test_another_version_is_refused_and_an_older_one_accepted(server):
    with server.client("00000100") as client:
        client.send("00000001")
        client.image()
    for version in ("00000115", "00000200", "00000000", "50414e47"):
        with server.client(None) as client:
            client.send(version)
            assert "protocol version" in client.error()
            assert client.is_closed()


def test_goodbye_has_no_reply(server):
    with server.client() as client:
        client.send("00000000")
        assert client.is_closed()


def test_a_client_may_end_the_server_only_if_allowed(world):
    with Running(world, conventions=Conventions(may_quit=True)) as running:
        with running.client() as client:
            client.send("0000001b")
            assert client.number() == 0
        running.thread.join(10)
        assert not running.thread.is_alive()


def test_clients_that_vanish_or_stall_hold_up_nobody(world):
    with Running(world, Limits(clients=4, message_s=0.5, idle_s=3.0)) as running:
        half = running.client()
        half.send("0000000b 0000")  # half a message
        gone = running.client()
        gone.send("00000001")
        gone.socket.close()
        with running.client() as good:
            for _ in range(5):
                good.send("00000001")
                good.image()
        assert half.is_closed()
        idle = running.client()
        start = time.monotonic()
        assert idle.is_closed()
        assert 2 < time.monotonic() - start < 8
        many = [running.client() for _ in range(4)]
        with pytest.raises((ConnectionError, AssertionError)):
            running.client()
        for client in many:
            client.socket.close()


def test_a_client_that_reads_nothing_is_disconnected_and_holds_up_nobody(world):
    with Running(world, Limits(message_s=1.0)) as running:
        slow = running.client()
        slow.send("00000001" * 20_000)
        with running.client() as good:
            start = time.monotonic()
            for _ in range(5):
                good.send("00000008 00000001 41")
                good.read(9)
            assert time.monotonic() - start < 5
        deadline = time.monotonic() + 15
        while not any("in time" in note or "gone" in note for note in running.notes):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        slow.socket.close()


def test_requests_of_several_clients_take_turns(server):
    finished = []

    def ask(name):
        with server.client() as client:
            for _ in range(5):
                client.send("00000001")
                client.image()
                finished.append(name)

    threads = [threading.Thread(target=ask, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(finished) == 15
    assert len(set(finished[:7])) == 3  # none waits for another to finish
