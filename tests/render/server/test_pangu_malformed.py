"""Messages of PANGU's protocol that are faulty: errors, and a server that goes on."""

import random
import socket
import threading
import time

import numpy as np
import psutil
import pytest
from tests.render.server.conftest import Running
from tests.render.server.pangu_words import DOWN_1000, doubles, floats

from perilune_render.server import pangu_serve
from perilune_render.server import pangu_wire as wire
from perilune_render.server.pangu_answers import answer
from perilune_render.server.pangu_messages import MESSAGES
from perilune_render.server.serve import Limits


def test_every_setting_is_acknowledged_and_every_request_answered(client, world):
    """All messages with zeros: none desynchronises the stream, which an echo after each one shows."""
    for number, message in MESSAGES.items():
        if number in (0, 27):
            continue
        count = {272: "00000009"}.get(number, "")
        fields = wire.size_of(message.fields)
        payload = "00" * fields
        if count:
            payload = "00" * 8 + count + "00" * 81
        client.send(f"{number:08x}{payload}")
        client.send("00000008 00000003 616263")
        data = b""
        while not data.endswith(b"\0\0\0\x08\0\0\0\x03abc"):
            data += client.read(1)
        assert len(data) >= 15
        if message.effect == "read":
            assert data[:4] == b"\0\0\0\0"
        if message.effect == "refused":
            assert data[:4] == b"\0\0\0\1"
        if number in (256, 257, 268, 269, 278):
            client.send(f"00000100 {DOWN_1000}")
            assert client.number() == 0


@pytest.mark.parametrize(
    ("request_bytes", "message"),
    [
        ("0000000c" + floats(0, 0, 1000, 0, 0, 0, 0), "quaternion of length 0"),
        ("0000000b" + floats(0, 0, float("nan"), 0, -90, 0), "not finite"),
        ("0000000b" + floats(0, 0, -50, 0, -90, 0), "above the ground"),
        ("0000000b" + floats(1e5, 0, 1000, 0, -90, 0), "over the terrain"),
        ("00000105" + floats(180), "field of view"),
        ("00000105" + floats(0), "field of view"),
        ("00000106" + floats(0), "aspect"),
        ("00000006" + floats(0, 0, 0), "direction of length 0"),
        ("00000019 00" + floats(0, 0) + "ffffffff ffffffff" + floats(1, 0), "heights, expected"),
        ("0000001f 00000002 00 00000001 00000001" + floats(1, 1, 1), "camera 2"),
        ("00000120 00000009", "camera 9"),
        ("00000128 00000007 00000000", "camera 7"),
        ("00000128 00000001 00000001", "projection 1"),
        ("0000012b 00000007" + doubles(*[0.0] * 18), "camera 7"),
        ("0000012b 00000000" + doubles(1e16, *[0.0] * 17), "velocity of 1e+16 m/s, expected at most 12000"),
        ("00000023 00000002" + doubles(0, 0, 500, 0, 1, 0, 0), "camera 2"),
        ("00000022" + "00" * 100, "not simulated"),
        ("0000001b", "--allow-quit"),
    ],
)
def test_a_faulty_request_is_an_error_and_the_session_goes_on(client, request_bytes, message):
    client.send(request_bytes)
    assert message in client.error()
    client.send("00000008 00000001 41")
    assert [client.number(), client.number()] == [8, 1]
    client.read(1)
    client.send(f"0000000b {DOWN_1000}")
    client.image()


def test_the_fastest_camera_with_the_narrowest_view_gets_an_image(client, world):
    z = float(world.heights_m(np.zeros(1), np.zeros(1))[0]) + 1.2
    for request in (
        "00000105" + floats(0.0101),
        "0000012b 00000000" + doubles(6000, -8000, *[0.0] * 16),
        "00000100" + floats(0, 0, z, 0, -90, 0),
    ):
        client.send(request)
        assert client.number() == 0
    start = time.monotonic()
    client.send("00000001")
    client.image()
    assert time.monotonic() - start < 5


@pytest.mark.parametrize("fault", [OverflowError("too large"), ZeroDivisionError("by zero"), ValueError("wrong")])
def test_values_that_cannot_be_computed_with_are_an_error(fault):
    class Failing:
        def image(self):
            raise fault

    reply = answer(Failing(), MESSAGES[1], [], b"")
    assert reply[:4] == b"\0\0\0\1"
    assert str(fault).encode() in reply


def test_an_unknown_message_or_too_large_an_array_ends_the_session_with_an_error(server):
    for request, message in (("000003e7", "message 999"), ("00000003 7fffffff", "2147483647 items")):
        with server.client() as client:
            client.send(request)
            assert message in client.error()
            assert client.is_closed()


def plausible(message, rng):
    """A message with values that a client could send: places over the ground, views downwards, one or two items."""
    choices = {"u": ["00000000", "00000001", "00000002"], "b": ["00", "01"]}
    numbers = {"f": floats, "d": doubles}

    def words(layout):
        kinds = wire.expanded(layout)
        if kinds in ("ffffff", "dddddd"):
            return numbers[kinds[0]](rng.uniform(-50, 50), rng.uniform(-50, 50), rng.uniform(200, 900), 0, -90, 0)
        if kinds in ("fffffff", "ddddddd"):
            return numbers[kinds[0]](0, 0, rng.uniform(200, 900), 0, 1, 0, 0)
        return "".join(
            rng.choice(choices[kind]) if kind in choices else numbers[kind](rng.choice([0.1, 0.5, 1.0, 2.0, 30.0]))
            for kind in kinds
        )

    if not message.item:
        return bytes.fromhex(f"{message.number:08x}" + words(message.fields))
    fields = bytearray(bytes.fromhex(words(message.fields)))
    # The count is the last u of the fields.
    at = 4 * wire.expanded(message.fields).rindex("u") if set(wire.expanded(message.fields)) == {"u"} else None
    if at is None:
        return bytes.fromhex(f"{message.number:08x}") + bytes(wire.size_of(message.fields))
    fields[at : at + 4] = (2).to_bytes(4, "big")
    return message.number.to_bytes(4, "big") + fields + bytes.fromhex(words(message.item) + words(message.item))


def changed(data, rng):
    """A message with up to four bytes of its payload changed; some have another number, are cut, or have bytes added.

    Another number and another length end the session sooner or later, so they are rare.
    """
    data = bytearray(data)
    if len(data) > 4:
        for _ in range(rng.randint(0, 4)):
            data[rng.randrange(4, len(data))] = rng.randrange(256)
    if rng.random() < 0.03:
        data[rng.randrange(4)] = rng.randrange(256)
    if rng.random() < 0.03:
        data = data[: rng.randint(1, len(data))] + rng.randbytes(rng.randint(0, 9))
    return bytes(data)


def drained(client):
    """Read what the server sends until it closes the connection."""
    try:
        while client.socket.recv(1 << 16):
            pass
    except OSError:
        pass


def test_malformed_messages_neither_crash_nor_stall_the_server(world, monkeypatch):
    """10,000 valid messages with random bytes changed, cut or added, over many connections; then a valid one."""
    rng, replies, slowest_s = random.Random(3), [], [0.0]

    def counted(*given):
        start = time.monotonic()
        reply = answer(*given)
        slowest_s[0] = max(slowest_s[0], time.monotonic() - start)
        replies.append(int.from_bytes(reply[:4], "big") if len(reply) > 200 or reply[:4] != b"\0\0\0\2" else -1)
        return reply

    monkeypatch.setattr(pangu_serve, "answer", counted)
    requests = [message for number, message in MESSAGES.items() if number not in (0, 27)]
    with Running(world, Limits(clients=64, message_s=0.3, items=1000)) as running:
        before, sent = psutil.Process().memory_info().rss, 0
        while sent < 10_000:
            client = running.client()
            client.socket.settimeout(20)
            reader = threading.Thread(target=drained, args=(client,))
            reader.start()
            try:
                for _ in range(rng.randint(1, 20)):
                    client.socket.sendall(changed(plausible(rng.choice(requests), rng), rng))
                    sent += 1
                client.socket.shutdown(socket.SHUT_WR)
            except OSError:
                pass
            reader.join(30)
            assert not reader.is_alive()
            client.socket.close()
        with running.client() as good:
            good.send(f"0000000b {DOWN_1000}")
            good.image()
        assert running.thread.is_alive()
        assert psutil.Process().memory_info().rss - before < 200e6
        unexpected = [note for note in running.notes if "Error" in note and "TimeoutError" not in note]
        assert not unexpected
    # Half of the messages at least are answered, some by images, some by errors.
    assert len(replies) > 5000
    assert replies.count(2) > 100 and replies.count(1) > 100
    assert slowest_s[0] < 5
