"""Our own interface: the client, and requests that are refused."""

import json
import threading
import time

import numpy as np
import pytest
import zmq
from tests.render.server.native_running import NativeRunning

from perilune_render.server.grounds import Grounds
from perilune_shared.client import SceneClient
from perilune_shared.errors import UserError

DOWN = (0.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def address(simulated):
    running = NativeRunning(Grounds(simulated))
    yield running.address
    running.close()


@pytest.fixture
def scene(address):
    with SceneClient(address) as client:
        yield client


def test_a_client_learns_what_is_rendered(scene, simulated):
    found = scene.scene()
    assert (found.camera.width_px, found.camera.height_px) == (64, 48)
    assert found.sun_elevation_deg == 25
    assert found.extent_m == simulated.scene.grid.extent_m


def test_a_frame_has_the_arrays_that_were_asked_for(scene):
    plain = scene.frame((0, 0, 500), DOWN)
    assert plain.image.shape == (48, 64)
    assert plain.image.dtype == np.uint8
    assert plain.depth_m is None and plain.normal is None and plain.labels is None
    full = scene.frame((0, 0, 500), DOWN, depth=True, labels=True)
    assert np.median(np.abs(full.depth_m - 500)) < 20
    assert np.allclose(np.linalg.norm(full.normal, axis=-1), 1, atol=1e-5)
    assert len(full.labels["crater_id"]) == len(full.labels["ellipse_cx_px"]) > 5
    assert (full.image != plain.image).any()  # other noise
    again = scene.frame((0, 0, 500), DOWN, index=1)
    assert (again.image == full.image).all()


def test_sun_and_velocity_change_the_frame(scene):
    first = scene.frame((0, 0, 500), DOWN, index=0).image.astype(int)
    other = scene.frame((0, 0, 500), DOWN, index=0, sun_deg=(280, 25)).image.astype(int)
    assert np.corrcoef(first.ravel(), other.ravel())[0, 1] < 0.5
    fast = scene.frame((0, 0, 500), DOWN, index=0, velocity_mps=(8000, 0, 0)).image.astype(int)
    along = [np.abs(np.diff(image, axis=1)).mean() for image in (first, fast)]
    assert along[1] < 0.8 * along[0]


def test_absurd_velocities_are_refused(scene):
    for velocity in ((1e8, 0, 0), (9000, 9000, 0)):
        with pytest.raises(UserError, match=r"velocity_mps: got .*expected at most 12000 m/s"):
            scene.frame((0, 0, 500), DOWN, velocity_mps=velocity)


def test_craters_are_those_of_the_ground(scene, simulated):
    found = scene.craters()
    assert found["crater_id"].tolist() == simulated.scene.crater_id.tolist()
    assert (found["diameter_m"] == simulated.scene.craters.diameter_m).all()


def test_heights_are_those_of_the_ground(scene, simulated):
    found = scene.heights([0, 10, 1e6], [0, -20, 0])
    assert abs(found[0]) < 1
    assert np.isnan(found[2])


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"request": "frames"}, "got frames, expected one of scene, health, ground, frame, craters, heights"),
        ({"request": "scene", "path": "/etc/passwd"}, "path"),
        ({"request": "frame", "position_m": [0, 0, 500]}, "rotation_wxyz"),
        ({"request": "frame", "position_m": [0, 0, 500], "rotation_wxyz": [0, 0, 0, 0]}, "length 0"),
        ({"request": "frame", "position_m": [0, 0, float("nan")], "rotation_wxyz": [0, 1, 0, 0]}, "position_m"),
        ({"request": "frame", "position_m": [0, 0, -9], "rotation_wxyz": [0, 1, 0, 0]}, "above the ground"),
        ({"request": "frame", "position_m": [9e4, 0, 500], "rotation_wxyz": [0, 1, 0, 0]}, "over the terrain"),
        ({"request": "frame", "position_m": [0, 0, 0.6], "rotation_wxyz": [0, 1, 0, 0]}, "at least 1 m"),
        ({"request": "frame", "position_m": [400, 0, 900], "rotation_wxyz": [0, 1, 0, 0]}, "beyond the terrain's edge"),
        ({"request": "frame", "position_m": [0, 0, 1e8], "rotation_wxyz": [0, 1, 0, 0]}, "beyond the terrain's edge"),
        ({"request": "frame", "position_m": [0, 0, 500], "rotation_wxyz": [1, 0, 0, 0]}, "with the horizon in view"),
        ({"request": "frame", "position_m": [0, 0, 500], "rotation_wxyz": [0, 1, 0, 0], "index": -1}, "index"),
        (
            {
                "request": "frame",
                "position_m": [0, 0, 500],
                "rotation_wxyz": DOWN,
                "angular_velocity_radps": [80, 80, 0],
            },
            "angular_velocity_radps: got [80.0, 80.0, 0.0], expected at most 100 rad/s",
        ),
        ({"request": "heights", "x_m": [1, 2], "y_m": [1]}, "y_m"),
        ({"request": "heights", "x_m": [0] * 100_001, "y_m": [0] * 100_001}, "x_m"),
        ([], "request"),
        ("x" * 10, "request"),
    ],
)
def test_a_faulty_request_is_refused_and_the_server_lives(scene, request_, message):
    scene._socket.send(json.dumps(request_).encode())
    assert scene._socket.poll(20_000)
    (reply,) = scene._socket.recv_multipart()
    assert message in json.loads(reply)["error"]
    assert scene.frame((0, 0, 500), DOWN).image.shape == (48, 64)


def test_the_client_says_what_the_server_refused(scene):
    with pytest.raises(UserError, match="above the ground"):
        scene.frame((0, 0, -50), DOWN)


def test_bytes_that_are_no_json_and_messages_without_envelopes_are_survived(address):
    context = zmq.Context()
    dealer = context.socket(zmq.DEALER)
    dealer.setsockopt(zmq.LINGER, 0)
    dealer.connect(address)
    for content in (b"", b"\xff" * 100, b"[" * 100_000, b'{"request": "frame"'):
        dealer.send(content)
        assert dealer.poll(5000)
        assert "error" in json.loads(dealer.recv_multipart()[-1])
    dealer.close()
    context.term()


def test_a_server_that_is_not_there_is_an_error_in_time():
    start = time.monotonic()
    with SceneClient("tcp://127.0.0.1:9", timeout_s=0.3) as client, pytest.raises(UserError, match=r"none in 0\.3 s"):
        client.scene()
    assert time.monotonic() - start < 5
    with pytest.raises(UserError, match="address"):
        SceneClient("not an address")


@pytest.mark.parametrize(
    "reply",
    [
        [b"no json"],
        [b"[]"],
        [b'{"arrays": [{"name": "image", "dtype": "|u1", "shape": [2, 2]}]}'],
        [b'{"arrays": [{"name": "image", "dtype": "|O", "shape": [1]}]}', b"12345678"],
        [b'{"arrays": [{"name": "image", "dtype": "|u1", "shape": [-1, -4]}]}', b"1234"],
        [b'{"arrays": [{"name": "image", "dtype": "|u1", "shape": [3]}]}', b"1234"],
    ],
)
def test_a_hostile_server_gets_an_error(reply):
    context = zmq.Context()
    server = context.socket(zmq.REP)
    port = server.bind_to_random_port("tcp://127.0.0.1")

    def answer():
        server.recv()
        server.send_multipart(reply)

    thread = threading.Thread(target=answer)
    thread.start()
    with SceneClient(f"tcp://127.0.0.1:{port}", timeout_s=5) as client, pytest.raises(UserError, match="reply"):
        client.frame((0, 0, 500), DOWN)
    thread.join()
    server.close()
    context.term()
