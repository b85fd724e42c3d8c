"""Each message that sets viewpoint, lens, Sun or motion, by raw bytes: where the camera looks, and what it sees."""

import numpy as np
import pytest
from tests.render.server.conftest import FIELD_OF_VIEW_DEG, SIZE
from tests.render.server.pangu.words import DOWN_1000, as_doubles, as_float, doubles, floats

POSITION = (30.0, -40.0, 250.0)
YAW, PITCH, ROLL = np.radians((30.0, -70.0, 10.0))
DEGREES, RADIANS = (*POSITION, 30.0, -70.0, 10.0), (*POSITION, YAW, PITCH, ROLL)


def product(p, q):
    """Product of two quaternions, scalar first."""
    (a, b, c, d), (e, f, g, h) = p, q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def about(axis, angle):
    q = [np.cos(angle / 2), 0.0, 0.0, 0.0]
    q[axis] = np.sin(angle / 2)
    return tuple(q)


# The facts: qz(yaw) qx(pitch - 90 degrees) qz(-roll).
TURN = product(product(about(3, YAW), about(1, PITCH - np.pi / 2)), about(3, -ROLL))
QUATERNION = (*POSITION, *TURN)


def expected_axes():
    """Forward, right and top of the camera, from the facts' formula and a roll that leans the top to the left."""
    forward = np.array([-np.sin(YAW) * np.cos(PITCH), np.cos(YAW) * np.cos(PITCH), np.sin(PITCH)])
    right = np.array([np.cos(YAW), np.sin(YAW), 0])
    top = np.cross(right, forward)
    return forward, np.cos(ROLL) * right + np.sin(ROLL) * top, np.cos(ROLL) * top - np.sin(ROLL) * right


def looked_up(client, x, y):
    """Point of the ground in a place of the image."""
    client.send("00000004" + floats(x, y))
    assert client.number() == 5
    found = [as_float(client.read(4)) for _ in range(3)]
    assert client.read(1) == b"\1"
    return np.array(found)


def seen_axes(client, position=POSITION):
    """Forward of length 1, and right and top of the lengths of half the image, from points of the ground."""
    forward = looked_up(client, 0.5, 0.5) - position
    forward /= np.linalg.norm(forward)
    right, top = (looked_up(client, *place) - position for place in ((1, 0.5), (0.5, 1)))
    return forward, right / (right @ forward) - forward, top / (top @ forward) - forward


def okay(client, request):
    client.send(request)
    assert client.number() == 0


def image(client, request="00000001"):
    client.send(request)
    return client.image()[..., 0].astype(float)


def alike(a, b):
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


VIEWPOINTS = {
    11: floats(*DEGREES),
    12: floats(*QUATERNION),
    16: doubles(*DEGREES),
    17: doubles(*QUATERNION),
    26: doubles(*RADIANS),
    256: floats(*DEGREES),
    257: floats(*QUATERNION),
    268: doubles(*DEGREES),
    269: doubles(*QUATERNION),
    278: doubles(*RADIANS),
}


@pytest.mark.parametrize("number", VIEWPOINTS)
def test_all_messages_of_a_viewpoint_set_the_same_one(client, number):
    request = f"{number:08x}" + VIEWPOINTS[number]
    if number < 256:
        seen = image(client, request)
    else:
        okay(client, request)
        seen = image(client)
    forward, right, top = seen_axes(client)
    half = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))
    expected = expected_axes()
    assert np.allclose(forward, expected[0], atol=1e-5)
    assert np.allclose(right / half, expected[1], atol=1e-4)
    assert np.allclose(top / (half * SIZE[1] / SIZE[0]), expected[2], atol=1e-4)
    client.send("0000001d 00000001")
    assert [client.number() for _ in range(4)] == [16, 80, *SIZE]
    values = np.array(as_doubles(client.read(72)))
    assert np.allclose(values[2:5], POSITION)
    assert abs(values[5:] @ TURN) > 1 - 1e-9
    okay(client, "00000100" + floats(*DEGREES))
    assert alike(seen, image(client)) > 0.8
    okay(client, "00000100" + floats(*POSITION, 30, -70, -80))
    assert alike(seen, image(client)) < 0.6


def test_a_quaternion_in_hand_coded_words(client):
    # (0, 0, 400), and 150 degrees about x: (sin 15 degrees, cos 15 degrees, 0, 0). Not a half turn, so it has a sense.
    okay(client, "00000101 00000000 00000000 90000087 0907dc7d ee8dd47e 00000000 00000000")
    forward, _, _ = seen_axes(client, (0, 0, 400))
    assert np.allclose(forward, [0, -0.5, -np.sqrt(0.75)], atol=1e-5)


def test_field_of_view_by_radians_and_aspect_ratio(client):
    okay(client, f"00000100 {DOWN_1000}")
    okay(client, "00000117" + floats(0.5))
    okay(client, "00000106" + floats(2))
    _, right, top = seen_axes(client, (0, 0, 1000))
    assert np.allclose(right, [np.tan(0.25), 0, 0], atol=1e-5)
    assert np.allclose(top, [0, 2 * np.tan(0.25) * SIZE[1] / SIZE[0], 0], atol=1e-5)
    client.send("0000001d 00000000")
    assert [client.number() for _ in range(4)] == [16, 80, *SIZE]
    horizontal, vertical = as_doubles(client.read(72))[:2]
    assert np.isclose(horizontal, 0.5)
    assert np.isclose(vertical, 2 * np.arctan(2 * np.tan(0.25) * SIZE[1] / SIZE[0]))


def test_the_sun_by_radians_is_that_by_degrees(client):
    okay(client, f"00000100 {DOWN_1000}")
    okay(client, "00000118" + doubles(1.5e11, np.radians(60), np.radians(20)))
    by_radians = image(client)
    okay(client, "0000010f" + doubles(1e10, 60, 20))
    assert alike(by_radians, image(client)) > 0.8
    okay(client, "0000010f" + doubles(1e10, 240, 20))
    assert alike(by_radians, image(client)) < 0


def test_the_velocity_blurs_along_its_direction(client):
    def steps(velocity):
        """Mean square steps of an image along its rows and along its columns."""
        okay(client, "0000012b 00000001" + doubles(*velocity, *[0.0] * 15))
        grey = image(client)
        return np.square(np.diff(grey, axis=1)).mean(), np.square(np.diff(grey, axis=0)).mean()

    okay(client, "00000100" + floats(0, 0, 300, 0, -90, 0))
    still, along_x, along_y = steps((0, 0, 0)), steps((10_000, 0, 0)), steps((0, 10_000, 0))
    assert along_x[0] < 0.5 * still[0] and along_x[0] / along_x[1] < 0.7 * still[0] / still[1]
    assert along_y[1] < 0.5 * still[1] and along_y[0] / along_y[1] > 1.4 * still[0] / still[1]
