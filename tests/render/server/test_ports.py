"""Any bytes to either port of the server: valid clients of both interfaces are answered afterwards."""

import asyncio
import contextlib
import random
import time

import pytest
from tests.render.server.both import GREETING, READY, Both

from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError

HTTP = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:10364\r\nConnection: keep-alive\r\nUser-Agent: Mozilla/5.0 (X11; Linux "
    b"x86_64; rv:128.0) Gecko/20100101 Firefox/128.0\r\nAccept: text/html,application/xhtml+xml\r\n\r\n"
)
POST = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 20\r\n\r\n" + b'{"request": "scene"}'
TLS = bytes.fromhex("16030100c6010000c20303") + bytes(range(32)) + bytes(160)
FRAMES = {
    "an old version of ZeroMQ": bytes.fromhex("01000100"),
    "ZMTP 2": b"\xff" + bytes(7) + b"\x01\x7f" + b"\x01\x05" + bytes(2),
    "encryption": GREETING.replace(b"NULL" + bytes(5), b"CURVE" + bytes(4)),
    "a greeting alone": GREETING,
    "no command": GREETING + b"\x00\x01a",
    "an unknown socket": GREETING + b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03PUB",
    "a huge command": GREETING + b"\x06" + b"\xff" * 8,
    "a huge part": GREETING + READY + b"\x02" + b"\xff" * 8 + bytes(1000),
    "a part above the limit": GREETING + READY + b"\x02" + (4_000_001).to_bytes(8, "big"),
    "impossible flags": GREETING + READY + b"\xff\x05hello",
    "a command of several frames": GREETING + READY + b"\x05\x02ab",
    "commands for ever": GREETING + READY + b"\x04\x05\x04PING" * 2000,
    "parts for ever": GREETING + READY + b"\x01\x00" * 20_000,
    "HTTP": HTTP,
    "HTTP with a request": POST,
    "TLS": TLS,
    "many zeros": bytes(100_000),
}


@pytest.fixture(scope="module")
def both(simulated):
    with Both(simulated) as running:
        yield running


def send(both: Both, interface: str, content: bytes, *, wait_s: float = 0.05) -> bytes:
    """Send bytes as a client that then leaves; returns what it was sent within `wait_s`."""
    with both.connected(interface) as connection:
        connection.settimeout(wait_s)
        with contextlib.suppress(OSError):  # the server may have closed the connection
            connection.sendall(content)
            return connection.recv(1 << 16)
    return b""


@pytest.mark.parametrize("interface", ["native", "pangu"])
@pytest.mark.parametrize("name", FRAMES)
def test_valid_clients_are_answered_after_bytes_of_another_protocol(both, interface, name):
    send(both, interface, FRAMES[name])
    both.check()


@pytest.mark.parametrize("interface", ["native", "pangu"])
def test_valid_clients_are_answered_after_random_bytes_and_cut_messages(both, interface):
    rng = random.Random(5)
    valid = GREETING + READY + b"\x01\x00\x00\x14" + b'{"request": "scene"}'
    if interface == "pangu":
        valid = bytes.fromhex("00000114 00000001 0000000b") + bytes(24)
    for n in range(150):
        cut = rng.randrange(len(valid))
        bytes_of_kind = (rng.randbytes(rng.randrange(1, 300)), valid[:cut], valid[:cut] + rng.randbytes(40))
        send(both, interface, bytes_of_kind[n % 3], wait_s=0.01)
        if n % 10 == 9:
            both.check()


@pytest.mark.parametrize("interface", ["native", "pangu"])
def test_half_open_connections_hold_up_nobody_and_are_closed_in_time(both, interface):
    starts = [b"", b"\xff", GREETING, GREETING + READY[:4], GREETING + READY + b"\x01", bytes.fromhex("0000")]
    starts += [GREETING + READY + b"\x02" + (4_000_000).to_bytes(8, "big") + b"x"]
    held = [both.connected(interface) for _ in starts]
    for connection, start in zip(held, starts, strict=True):
        connection.sendall(start)
    both.check()
    begun = time.monotonic()
    for connection in held:
        with contextlib.suppress(ConnectionResetError):
            while connection.recv(1 << 16):
                pass
        connection.close()
    assert time.monotonic() - begun < 10
    both.check()


def test_what_is_not_zeromq_is_closed_at_once(both):
    for content in (HTTP, TLS, FRAMES["an old version of ZeroMQ"]):
        begun = time.monotonic()
        with both.connected("native") as connection:
            connection.sendall(content)
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(100) == b""
        assert time.monotonic() - begun < 1


def test_many_connections_without_a_word_do_not_lock_clients_out(simulated):
    with Both(simulated) as both:
        held = [both.connected(name) for name in ("native", "pangu") for _ in range(300)]
        time.sleep(1.2)
        both.check()
        for connection in held:
            connection.close()


def test_health_names_an_interface_that_does_not_answer(simulated, monkeypatch):
    async def silent(reader, writer):
        await asyncio.sleep(60)

    async def wrong(reader, writer):
        return False

    monkeypatch.setattr("perilune_render.server.native.serve._HEALTH_S", 0.3)
    with Both(simulated) as both, SceneClient(both.address, timeout_s=20) as scene:
        both.check()
        for greets in (silent, wrong):
            both.pangu.greets = greets
            with pytest.raises(UserError, match=f"PANGU at 127.0.0.1:{both.pangu.port}: does not answer"):
                scene.health()


def test_health_is_answered_with_all_clients_of_pangu_connected(simulated):
    with Both(simulated) as both:
        held = [both.connected("pangu") for _ in range(both.pangu.limits.clients)]
        for connection in held:
            connection.sendall(bytes.fromhex("00000114 00000008 00000001 41"))
            assert connection.recv(100)
        with SceneClient(both.address, timeout_s=20) as scene:
            assert "PANGU" in scene.health()
        for connection in held:
            connection.close()
        # Forgotten, so that no client passes the limit by such a port.
        assert not both.pangu.probes and not both.native.probes


@pytest.mark.parametrize("fault", ["stopped", "interrupted", "ended"])
def test_the_end_of_the_connections_ends_the_server_with_an_error(simulated, fault):
    def interrupted():
        raise KeyboardInterrupt

    def ended():
        raise SystemExit(3)

    with Both(simulated) as both:
        loop = both.server._loop
        if fault == "stopped":
            loop.call_soon_threadsafe(loop.stop)
        elif fault == "interrupted":
            loop.call_soon_threadsafe(interrupted)
        else:
            loop.call_soon_threadsafe(ended)
        both.thread.join(20)
        assert not both.thread.is_alive()
        assert isinstance(both.failure, UserError) and "connections: got ended by" in str(both.failure)


def test_a_port_that_stops_listening_ends_the_server_with_an_error(simulated):
    with Both(simulated) as both:
        both.check()
        both.server._loop.call_soon_threadsafe(both.native.listening.close)
        both.thread.join(20)
        assert isinstance(both.failure, UserError) and "perilune_shared.client" in str(both.failure)


def test_an_error_in_a_connection_is_noted(simulated, monkeypatch):
    with Both(simulated) as both:
        monkeypatch.setattr("perilune_render.server.native.zmtp._head", lambda *_: 1 / 0)
        send(both, "native", GREETING + READY, wait_s=1)
        deadline = time.monotonic() + 10
        while not any("disconnected: ZeroDivisionError" in note for note in both.notes):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        monkeypatch.undo()
        both.check()
