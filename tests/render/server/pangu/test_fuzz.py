"""Messages of PANGU's protocol with random bytes changed, cut or added."""

import contextlib
import random
import time
from collections import Counter

import psutil
import pytest
from tests.render.server.conftest import Running
from tests.render.server.pangu.valid import VALID
from tests.render.server.pangu.words import DOWN_1000

from perilune_render.server.connection import Limits
from perilune_render.server.pangu import serve as pangu_serve
from perilune_render.server.pangu import wire
from perilune_render.server.pangu.answers import answer
from perilune_render.server.pangu.messages import ECHO, ERROR, GOODBYE, IMAGE, MESSAGES, QUIT

LONGEST_S = 5.0
"""Time within which each message must be answered on a busy core: the largest grid has a million heights."""
IMAGES = (1, 11, 12, 16, 17, 26, 30)


class Counting:
    """Answers as the server does, and counts."""

    def __init__(self):
        self.reached, self.replies, self.longest_s = Counter(), Counter(), 0.0

    def __call__(self, session, message, values, items):
        start = time.monotonic()
        reply = answer(session, message, values, items)
        self.longest_s = max(self.longest_s, time.monotonic() - start)
        if message.number != ECHO:  # the test's own marks
            self.reached[message.number] += 1
            self.replies[message.number, int.from_bytes(reply[:4], "big")] += 1
        return reply


def with_changed_payload(rng, number):
    """A message of the right length, with up to 4 bytes of its numbers changed; counts of arrays stay."""
    data = bytearray(VALID[number])
    first = 4 + (wire.size_of(MESSAGES[number].fields) if MESSAGES[number].item else 0)
    for _ in range(rng.choice((0, 1, 1, 2, 4))):
        if first < len(data):
            data[rng.randrange(first, len(data))] = rng.randrange(256)
    return bytes(data)


def broken(rng):
    """A message of the wrong number or length, or with a wrong count."""
    data = bytearray(VALID[rng.choice(list(VALID))])
    for _ in range(rng.randint(1, 4)):
        data[rng.randrange(min(len(data), 16))] = rng.randrange(256)
    if rng.random() < 0.6:
        data = data[: rng.randint(1, len(data))] + rng.randbytes(rng.randint(0, 9))
    return bytes(data)


def answered(client, data, mark):
    """Send a message and an echo of 8 bytes, and read until the echo has come back."""
    client.socket.sendall(data + bytes.fromhex("0000000800000008") + mark)
    end, found = bytes.fromhex("0000000800000008") + mark, bytearray()
    while not found.endswith(end):
        part = client.socket.recv(1 << 16)
        assert part, f"the session ended after {data[:80].hex()}"
        found += part


def test_every_valid_message_is_accepted(client):
    assert set(VALID) == set(MESSAGES) - {GOODBYE, ECHO, QUIT}
    for number, data in VALID.items():
        client.socket.sendall(data + bytes.fromhex("000000080000000141"))
        reply = bytearray()
        while not reply.endswith(bytes.fromhex("000000080000000141")):
            reply += client.socket.recv(1 << 16)
        is_error = int.from_bytes(reply[:4], "big") == ERROR
        assert is_error == (MESSAGES[number].effect == "refused"), f"{number}: {bytes(reply[:200])}"


@pytest.mark.parametrize("n_messages", [1500, pytest.param(6000, marks=pytest.mark.slow)])
def test_malformed_messages_neither_crash_nor_stall_the_server(simulated, n_messages, monkeypatch, caplog):
    rng, counting, n_broken = random.Random(3), Counting(), 0
    monkeypatch.setattr(pangu_serve, "answer", counting)
    with Running(simulated, Limits(clients=64, message_s=20.0, items=1000)) as running:
        before = psutil.Process().memory_info().rss
        sent = 0
        while sent < n_messages:
            with running.client() as client:
                for _ in range(rng.randint(5, 20)):
                    answered(client, with_changed_payload(rng, rng.choice(list(VALID))), rng.randbytes(8))
                    sent += 1
                client.socket.settimeout(0.02)
                with contextlib.suppress(OSError):  # what follows a broken message is not known
                    client.socket.sendall(broken(rng))
                    client.socket.recv(1 << 16)
                n_broken += 1
        with running.client() as good:
            good.send(f"0000000b {DOWN_1000}")
            good.image()
        assert running.thread.is_alive()
        assert psutil.Process().memory_info().rss - before < 200e6
    assert not [note for note in running.notes if "disconnected" in note and "in time" not in note]
    assert not [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")]
    assert counting.longest_s < LONGEST_S
    assert sum(counting.reached.values()) > 0.8 * (sent + n_broken)
    assert set(VALID) <= set(counting.reached)
    images = sum(counting.replies[number, IMAGE] for number in IMAGES)
    assert images > 0.25 * sum(counting.reached[number] for number in IMAGES)
    assert sum(count for (_, reply), count in counting.replies.items() if reply == ERROR) > 100
