"""Messages of PANGU's protocol that are faulty: errors, and a server that goes on."""

import time

import numpy as np
import pytest
from tests.render.server.pangu.words import DOWN_1000, doubles, floats

from perilune_render.server.pangu import wire
from perilune_render.server.pangu.answers import answer
from perilune_render.server.pangu.messages import MESSAGES


def test_every_setting_is_acknowledged_and_every_request_answered(client, simulated):
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


def test_the_fastest_camera_with_the_narrowest_view_gets_an_image(client, simulated):
    z = float(simulated.heights_m(np.zeros(1), np.zeros(1))[0]) + 1.2
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
