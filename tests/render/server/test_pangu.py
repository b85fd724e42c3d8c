"""PANGU's protocol by raw bytes: the vectors of the facts sheet, and values that were computed by hand."""

import random
import struct
import threading
import time

import numpy as np
import psutil
import pytest
from tests.render.server.conftest import FIELD_OF_VIEW_DEG, SIZE, Running

from perilune_render.server import pangu_wire as wire
from perilune_render.server.pangu_messages import MESSAGES
from perilune_render.server.pangu_session import Conventions
from perilune_render.server.pangu_view import rotation_from_angles, rotation_from_quaternion, sun_from_angles
from perilune_render.server.serve import Limits
from perilune_render.terrain.interpolation import value_at

DOWN_1000 = "00000000 00000000 f4000088 00000000 68000185 00000000"
"""Position (0, 0, 1000) and angles (0, -90, 0) as floats."""
FLOATS = {0: "00000000", 1: "0000007f", -1: "0000017f", -2.5: "40000180", 0.1: "99999a7b", 1000: "f4000088"}
FLOATS |= {-90: "68000185"}
DOUBLES = {0: "0" * 16, 1: "000003ff00000000", -1: "00000bff00000000", -2.5: "00000c0040000000"}
DOUBLES |= {0.1: "9999a3fb99999999", 1000: "00000408f4000000", np.pi: "42d18400921fb544"}


def floats(*values):
    """Floats by the definition: fraction, sign, exponent from the top."""
    words = []
    for value in values:
        word = struct.unpack(">I", struct.pack(">f", value))[0]
        sign, exponent, fraction = word >> 31, (word >> 23) & 0xFF, word & 0x7FFFFF
        words.append(f"{(fraction << 9) | (sign << 8) | exponent:08x}")
    return "".join(words)


def as_float(data):
    word = int.from_bytes(data, "big")
    return struct.unpack(">f", struct.pack(">I", ((word >> 8 & 1) << 31) | ((word & 0xFF) << 23) | (word >> 9)))[0]


@pytest.mark.parametrize(("value", "word"), FLOATS.items())
def test_floats_are_those_of_the_facts(value, word):
    assert wire.float_bytes([value]).hex() == word
    assert wire.floats_from(bytes.fromhex(word))[0] == np.float32(value)
    assert floats(value) == word


@pytest.mark.parametrize(("value", "word"), DOUBLES.items())
def test_doubles_are_those_of_the_facts(value, word):
    assert wire.double_bytes([value]).hex() == word
    assert wire.doubles_from(bytes.fromhex(word))[0] == value


def test_texts_are_those_of_the_facts():
    assert wire.text_bytes("abc").hex() == "000461626300"
    assert wire.text_bytes("abcd").hex() == "0006616263640000"


def test_numbers_that_a_client_cannot_read_are_never_sent():
    assert wire.floats_from(wire.float_bytes([np.inf, -1e300])).tolist() == [np.finfo("f4").max, -np.finfo("f4").max]
    for wrong in (wire.float_bytes, wire.double_bytes):
        with pytest.raises(ValueError, match="sent"):
            wrong([np.nan])


def test_a_client_sets_a_viewpoint_and_gets_its_image(client, world):
    client.send(f"00000100 {DOWN_1000}")
    assert client.number() == 0
    client.send("00000001")
    image = client.image()
    assert (image[..., 0] == image[..., 1]).all()
    assert image.std() > 5
    client.send(f"0000000b {DOWN_1000}")
    again = client.image()
    assert np.median(np.abs(again.astype(int) - image)) <= 8  # other noise only
    client.send("00000002")
    assert client.number() == 3
    height = as_float(client.read(4))
    assert client.read(1) == b"\1"
    assert abs(height - 1000) < 1  # the site is at 0


def test_a_point_in_the_image_is_where_the_pixel_shows_it(client, world):
    client.send(f"00000100 {DOWN_1000}")
    assert client.number() == 0
    # The facts: LookupPoint(0.5, 0.25), below the middle of the image, so at negative y with +y on top.
    client.send("00000004 0000007e 0000007d")
    assert client.number() == 5
    x, y, z = (as_float(client.read(4)) for _ in range(3))
    assert client.read(1) == b"\1"
    per_pixel = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)) / (SIZE[0] / 2)
    assert abs(x) < 0.01
    assert np.isclose(y, -0.25 * SIZE[1] * per_pixel * (1000 - z), rtol=1e-5)
    assert abs(z - value_at(world.scene.height_m, world.scene.grid, x, y)) < 1.0
    client.send("00000006" + floats(0, 0, -2))
    assert client.number() == 5
    assert [round(as_float(client.read(4)), 2) for _ in range(2)] == [0, 0]
    client.read(5)
    client.send("00000006" + floats(0, 0, 1))  # the sky
    assert client.number() == 5
    assert client.read(13)[-1] == 0


def test_lists_of_points_have_as_many_items_as_were_asked_for(client):
    for number, size, reply, item in ((3, 3, 4, 5), (5, 2, 6, 13), (7, 3, 6, 13)):
        client.send(f"{number:08x} 00000003" + floats(*[0.1, 0.2, -0.5][:size] * 3))
        assert client.number() == reply
        assert client.number() == 3
        client.read(3 * item)
        client.send(f"{number:08x} 00000000")
        assert [client.number(), client.number()] == [reply, 0]


def test_surface_patch_is_a_turned_grid_of_heights(client, world):
    client.send("00000019 00" + floats(20, -30) + "00000003 00000002" + floats(4, np.pi / 2))
    assert client.number() == 4
    assert client.number() == 6
    found = [as_float(client.read(5)[:4]) for _ in range(6)]
    # Turned by 90 degrees, local x is +y and local y is -x.
    places = [(20 - y, -30 + x) for y in (-2, 2) for x in (-4, 0, 4)]
    expected = [float(value_at(world.scene.height_m, world.scene.grid, x, y)) for x, y in places]
    assert np.allclose(found, expected, rtol=0, atol=0.2)
    client.send("00000017 00" + floats(1e5, 0))
    assert client.number() == 3
    assert client.read(5)[-1] == 0


def test_a_lidar_pulse_has_range_and_cosine(client):
    client.send("0000000d" + floats(0, 0, 500, 0, 0, -3))
    assert client.number() == 9
    distance, cosine = (as_float(client.read(4)) for _ in range(2))
    assert abs(distance - 500) < 1
    assert 0.8 < cosine <= 1
    client.send("0000000d" + floats(0, 0, 500, 0, 0, 3))
    assert [client.number(), client.number(), client.number()] == [9, 0, 0]


def test_camera_properties_and_field_of_view(client):
    client.send("00000105" + floats(60))
    assert client.number() == 0
    client.send(f"00000100 {DOWN_1000}")
    assert client.number() == 0
    client.send("0000001d 00000000")
    assert [client.number() for _ in range(4)] == [16, 80, *SIZE]
    values = wire.doubles_from(client.read(72))
    assert np.isclose(values[0], np.radians(60), rtol=1e-6)
    assert np.isclose(np.tan(values[1] / 2), np.tan(np.radians(30)) * SIZE[1] / SIZE[0], rtol=1e-6)
    assert values[2:5].tolist() == [0, 0, 1000]
    assert np.allclose(np.abs(values[5:]), [0, 1, 0, 0], atol=1e-7)
    client.send("0000001d 00000007")
    assert [client.number(), client.number()] == [16, 0]


def test_the_sun_moves_and_darkens(client):
    client.send(f"0000000b {DOWN_1000}")
    lit = client.image()
    client.send("0000010f" + "0" * 32 + DOUBLES[-2.5])  # elevation -2.5 degrees
    assert client.number() == 0
    client.send("00000001")
    assert client.image().mean() < 0.2 * lit.mean()


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


def test_the_time_of_the_last_image(client):
    client.send("00000021")
    assert client.number() == 12
    assert client.read(9)[-1] == 0
    client.send("00000001")
    client.image()
    client.send("00000021")
    assert client.number() == 12
    microseconds = wire.doubles_from(client.read(8))[0]
    assert client.read(1) == b"\1"
    assert abs(microseconds / 1e6 - time.time()) < 60


@pytest.mark.parametrize(
    ("angles_deg", "forward", "right"),
    [
        ((0, 0, 0), (0, 1, 0), (1, 0, 0)),
        ((0, -90, 0), (0, 0, -1), (1, 0, 0)),
        ((90, -90, 0), (0, 0, -1), (0, 1, 0)),
        ((90, 0, 0), (-1, 0, 0), (0, 1, 0)),
        ((135, -25, 0), (-0.7071 * 0.9063, -0.7071 * 0.9063, -0.4226), None),
    ],
)
def test_viewpoints_by_angles(angles_deg, forward, right):
    rotation = rotation_from_angles(*np.radians(angles_deg))
    assert np.allclose(rotation[2], forward, atol=1e-3)
    if right is not None:
        assert np.allclose(rotation[0], right, atol=1e-9)
    assert np.isclose(np.linalg.det(rotation), 1)


def test_roll_leans_the_top_to_the_stated_side():
    for sense, side in (("left", -1), ("right", 1)):
        rotation = rotation_from_angles(0, 0, np.radians(10), sense)
        assert np.sign(-rotation[1] @ [1, 0, 0]) == side  # the camera's top, along the world's right


def test_viewpoints_by_quaternion():
    assert np.allclose(rotation_from_quaternion(np.array([0, 2.0, 0, 0])), rotation_from_angles(0, -np.pi / 2, 0))


def test_both_zeros_of_the_suns_azimuth():
    assert np.allclose(sun_from_angles(np.pi / 2, 0, "clockwise-from-y"), [1, 0, 0])
    assert np.allclose(sun_from_angles(np.pi / 2, 0, "anticlockwise-from-x"), [0, 1, 0])


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


def test_an_unknown_message_or_too_large_an_array_ends_the_session_with_an_error(server):
    for request, message in (("000003e7", "message 999"), ("00000003 7fffffff", "2147483647 items")):
        with server.client() as client:
            client.send(request)
            assert message in client.error()
            assert client.is_closed()


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


def test_malformed_messages_neither_crash_nor_stall_the_server(world):
    """Valid messages with random bytes changed, cut or added, over many connections; then a valid one."""
    rng = random.Random(3)
    valid = [
        bytes.fromhex(f"{n:08x}") + b"\0" * wire.size_of(m.fields) for n, m in MESSAGES.items() if n not in (0, 27)
    ]
    valid.append(bytes.fromhex(("0000000b" + DOWN_1000).replace(" ", "")))
    with Running(world, Limits(clients=64, message_s=0.05, items=1000)) as running:
        before = psutil.Process().memory_info().rss
        sent = 0
        while sent < 10_000:
            client = running.client()
            client.socket.settimeout(0.02)
            try:
                for _ in range(rng.randint(1, 20)):
                    data = bytearray(rng.choice(valid))
                    for _ in range(rng.randint(0, 4)):
                        data[rng.randrange(len(data))] = rng.randrange(256)
                    if rng.random() < 0.2:
                        data = data[: rng.randint(1, len(data))] + rng.randbytes(rng.randint(0, 9))
                    client.socket.sendall(data)
                    sent += 1
                client.socket.recv(1 << 16)
            except OSError:
                pass
            client.socket.close()
        with running.client() as good:
            good.send(f"0000000b {DOWN_1000}")
            good.image()
        assert running.thread.is_alive()
        assert psutil.Process().memory_info().rss - before < 200e6
