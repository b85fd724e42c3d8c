"""Malformed messages to our own interface: each is answered in time, and other clients get the same frames after."""

import copy
import json
import random

import pytest
import zmq
from tests.render.server.native_running import NativeRunning

from perilune_render.server.grounds import Grounds
from perilune_shared.client import SceneClient

SEED = 7
ANSWER_MS = 10_000
PER_CONNECTION = 50
DOWN = [0.0, 1.0, 0.0, 0.0]
VALID = (
    {"request": "scene"},
    {"request": "ground", "scene": 0},
    {
        "request": "frame",
        "position_m": [0.0, 0.0, 500.0],
        "rotation_wxyz": DOWN,
        "velocity_mps": [1.0, 2.0, -30.0],
        "angular_velocity_radps": [0.1, 0.0, -0.2],
        "sun_deg": [100.0, 25.0],
        "index": 3,
        "depth": True,
        "labels": True,
        "scene": 0,
    },
    {"request": "craters", "scene": 0},
    {"request": "heights", "x_m": [0.0, 10.0], "y_m": [5.0, -5.0], "boulders": False, "scene": 0},
)
VALUES = (
    None, True, False, 0, -1, 1, 0.5, -0.0, 1e-320, 1e9, -1e9, 1e10, 1e308, -1e308, float("nan"), float("inf"),
    2**31, 2**63, 2**64, 10**400, "HUGE", "1E999", "", "0", "frame", "\ud800", "\0", "x" * 10_000, [], [[]], {},
    {"scene": 0}, [0.0], [0.0] * 3, [1e9] * 3, [-1e9] * 4, [float("nan")] * 3, [None] * 3, [0.0] * 1000,
)  # fmt: skip


def changed(rng, request):
    """A request with one field, or one item of it, changed, removed or added."""
    request = copy.deepcopy(request)
    name = rng.choice(list(request))
    kind = rng.random()
    if kind < 0.15:
        del request[name]
    elif kind < 0.25:
        request[rng.choice(["scene", "index", "path", "", "labels.x", "__class__"])] = rng.choice(VALUES)
    elif kind < 0.5 or not isinstance(request[name], list) or not request[name]:
        request[name] = rng.choice(VALUES)
    elif kind < 0.6:
        request[name] = request[name] * rng.choice([0, 2, 500])
    else:
        random_number = rng.choice([-1, 1]) * 10 ** rng.uniform(-9, 6)
        request[name][rng.randrange(len(request[name]))] = rng.choice([*VALUES, *[random_number] * len(VALUES)])
    return request


def text_of(request):
    """JSON of a request, with numbers that Python neither reads nor writes."""
    return json.dumps(request).replace('"HUGE"', "1" + "0" * 5000).replace('"1E999"', "-1e999")


def message(rng):
    """The parts of a message."""
    request = rng.choice(VALID)
    for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
        request = changed(rng, request) if request else request
    content = bytearray(text_of(request).encode())
    kind = rng.random()
    if kind < 0.08:
        content = content[: rng.randrange(len(content) + 1)]
    elif kind < 0.2:
        for _ in range(rng.randint(1, 4)):
            content[rng.randrange(len(content))] = rng.randrange(256)
    elif kind < 0.25:
        content += rng.choice([b"}", b"]" * 1000, b"\0", bytes(content), rng.randbytes(20)])
    elif kind < 0.3:
        content = bytearray(rng.choice([b"", b"[" * 5000, b'{"a":' * 5000, rng.randbytes(100), b"1" * 100_000]))
    extra = [rng.choice([b"", b"\0", content, rng.randbytes(30)]) for _ in range(rng.randint(0, 3))]
    shapes = [[b"", content]] * 6 + [[content], [b"", content, *extra], [*extra, content]]
    return [bytes(part) for part in rng.choice(shapes)]


@pytest.mark.parametrize("n_messages", [1200, pytest.param(5000, marks=pytest.mark.slow)])
def test_malformed_messages_are_answered_in_time_and_others_get_the_same_frames(simulated, n_messages):
    rng = random.Random(SEED)
    answers = {"error": 0, "result": 0}
    with (
        NativeRunning(Grounds(simulated, 2)) as running,
        SceneClient(running.address) as good,
        zmq.Context() as context,
    ):
        before = good.frame((0, 0, 500), DOWN, index=0, labels=True)
        for n in range(n_messages):
            if n % PER_CONNECTION == 0:
                socket = context.socket(zmq.DEALER)
                socket.setsockopt(zmq.LINGER, 0)
                socket.connect(running.address)
            parts = message(rng)
            socket.send_multipart(parts)
            assert socket.poll(ANSWER_MS), parts
            reply = socket.recv_multipart()
            head = json.loads(reply[1] if reply[0] == b"" else reply[0])
            assert "busy" not in head, head
            answers["error" if "error" in head else "result"] += 1
            assert not [note for note in running.notes if "disconnected" in note or "client:" in note], parts
            if n % PER_CONNECTION == PER_CONNECTION - 1:
                socket.close()
        after = good.frame((0, 0, 500), DOWN, index=0, labels=True)
    assert (after.image == before.image).all()
    assert (after.labels["crater_id"] == before.labels["crater_id"]).all()
    assert min(answers.values()) > n_messages / 10
