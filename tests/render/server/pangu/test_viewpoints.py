"""PANGU's viewpoints, field of view, Sun and images by raw bytes."""

import time
from concurrent.futures import Future

import numpy as np
import pytest
from tests.render.server.conftest import SIZE
from tests.render.server.pangu.words import DOUBLES, DOWN_1000, as_doubles, as_float, floats

from perilune_render.server.pangu import wire
from perilune_render.server.pangu.view import rotation_from_angles, rotation_from_quaternion, sun_from_angles


def test_a_client_sets_a_viewpoint_and_gets_its_image(client, simulated):
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


def time_tag_s(client):
    """Time of the last image, seconds since 1970; None if there is none."""
    client.send("00000021")
    assert client.number() == 12
    data = client.read(9)
    return as_doubles(data[:8])[0] / 1e6 if data[8] else None


def test_the_time_of_the_last_image(server, client):
    assert time_tag_s(client) is None
    client.send("0000000b" + floats(0, 0, -50, 0, -90, 0))  # refused: no image
    assert "above the ground" in client.error()
    assert time_tag_s(client) is None
    server.server._work.put((lambda: time.sleep(0.6), Future()))  # the renderer is busy
    before = time.time()
    client.send(f"0000000b {DOWN_1000}")
    client.image()
    tag = time_tag_s(client)
    assert before - 0.01 <= tag < before + 0.3  # when the image was asked for, not when it was rendered
    client.send("0000000b" + floats(0, 0, -50, 0, -90, 0))
    client.error()
    assert time_tag_s(client) == tag


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
    # Camera x to world y, y to z, z to x: a third of a turn, which the opposite sense would send the other way.
    rotation = rotation_from_quaternion(np.array([0.5, 0.5, 0.5, 0.5]))
    assert np.allclose(rotation, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    # Yaw 90, pitch -45: looks along -x and down, right is +y.
    rotation = rotation_from_quaternion(np.array([0.270598, -0.653281, -0.653281, 0.270598]))
    assert np.allclose(rotation[2], [-np.sqrt(0.5), 0, -np.sqrt(0.5)], atol=1e-6)
    assert np.allclose(rotation[0], [0, 1, 0], atol=1e-6)


def test_both_zeros_of_the_suns_azimuth():
    assert np.allclose(sun_from_angles(np.pi / 2, 0, "clockwise-from-y"), [1, 0, 0])
    assert np.allclose(sun_from_angles(np.pi / 2, 0, "anticlockwise-from-x"), [0, 1, 0])
