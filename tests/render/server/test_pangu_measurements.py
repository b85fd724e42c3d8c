"""PANGU's measurements by raw bytes, against the heights of the scene."""

import numpy as np
from tests.render.server.conftest import FIELD_OF_VIEW_DEG, SIZE
from tests.render.server.pangu_words import DOWN_1000, as_float, floats

from perilune_render.terrain.interpolation import value_at


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
