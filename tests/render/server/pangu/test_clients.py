"""Sessions of PANGU's clients: versions, limits, several at once."""

import threading
import time

from tests.render.server.conftest import Running

from perilune_render.server.connection import Limits
from perilune_render.server.pangu.session import Conventions
from perilune_render.server.serve import LineQueue


def echo(client):
    client.send("00000008 00000001 41")
    assert [client.number(), client.number()] == [8, 1]
    assert client.read(1) == b"A"


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


def test_a_client_may_end_the_server_only_if_allowed(simulated):
    with Running(simulated, conventions=Conventions(may_quit=True)) as running:
        with running.client() as client:
            client.send("0000001b")
            assert client.number() == 0
        running.thread.join(10)
        assert not running.thread.is_alive()


def test_clients_that_vanish_or_stall_hold_up_nobody(simulated):
    with Running(simulated, Limits(clients=4, message_s=0.5, idle_s=3.0)) as running:
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


def test_a_hello_and_a_begun_number_must_come_in_the_time_of_a_message(simulated):
    with Running(simulated, Limits(message_s=0.5, idle_s=60.0)) as running:
        silent, half_hello, half_number, idle = (
            running.client(None),
            running.client(None),
            running.client(),
            running.client(),
        )
        half_hello.send("0000")
        half_number.send("0000")
        start = time.monotonic()
        assert silent.is_closed() and half_hello.is_closed() and half_number.is_closed()
        assert time.monotonic() - start < 5
        echo(idle)  # silence between messages is not limited by message_s


def test_a_message_that_drips_is_ended_in_the_time_of_one_message(simulated):
    with Running(simulated, Limits(message_s=0.6, idle_s=60.0)) as running:
        drips = running.client()
        drips.send("0000")
        time.sleep(0.4)
        drips.send("0003 0000")  # GetElevations, and half of its count
        start = time.monotonic()
        assert drips.is_closed()
        assert time.monotonic() - start < 0.5


def test_silent_clients_give_way_and_an_extra_client_gets_an_error(simulated):
    with Running(simulated, Limits(clients=3, message_s=20.0, idle_s=60.0)) as running:
        asking = running.client()
        echo(asking)
        said_hello, silent = running.client(), running.client(None)
        with running.client(None) as extra:  # the others have been silent for a moment only
            extra.send("00000114")
            assert "3 clients" in extra.error()
            assert extra.is_closed()
        time.sleep(1.2)
        new = []
        for given_up in (said_hello, silent):
            new.append(running.client())
            echo(new[-1])
            assert given_up.is_closed()
        with running.client(None) as extra:
            extra.send("00000114")
            assert "3 clients" in extra.error()
        for each in (asking, *new):
            echo(each)


def test_sockets_without_a_word_do_not_lock_clients_out(simulated):
    with Running(simulated, Limits(clients=4, message_s=1.5, idle_s=60.0)) as running:
        held = [running.client(None) for _ in range(30)]
        time.sleep(1.6)
        with running.client() as client:
            echo(client)
        for each in held:
            each.socket.close()


def test_the_server_ends_at_once_with_clients_connected(simulated, capfd):
    for _ in range(10):
        with Running(simulated) as running:
            client = running.client()
            start = time.monotonic()
        assert time.monotonic() - start < 3
        assert client.is_closed()
    assert "Traceback" not in capfd.readouterr().err


def test_notes_that_nobody_reads_do_not_block_the_server(simulated):
    free = threading.Event()
    with Running(simulated, note=lambda text: free.wait(60)) as running:
        for _ in range(3):
            with running.client() as client:
                echo(client)
        free.set()


def test_notes_are_passed_on_in_order_and_dropped_when_there_are_too_many():
    begun, free, got = threading.Event(), threading.Event(), []

    def slow(text):
        begun.set()
        free.wait(20)
        got.append(text)

    notes = LineQueue(slow, most=3)
    notes("0")
    assert begun.wait(20)
    for k in range(1, 10):
        notes(str(k))
    free.set()
    notes.close(20)
    assert got == ["0", "1", "2", "3"]


def test_a_client_that_reads_nothing_is_disconnected_and_holds_up_nobody(simulated):
    with Running(simulated, Limits(message_s=1.0)) as running:
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
