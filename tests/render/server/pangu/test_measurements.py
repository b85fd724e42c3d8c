"""PANGU's measurements by raw bytes, against the heights of the scene."""

import struct

import numpy as np
import pytest
from tests.render.server.conftest import FIELD_OF_VIEW_DEG, SIZE
from tests.render.server.pangu.words import DOWN_1000, as_float, doubles, floats

from perilune_render.terrain.interpolation import value_at

TOLERANCE_M = 0.2
"""Between the facets that rays hit and the interpolated heights."""


@pytest.fixture
def height(simulated):
    """Heights of the ground, by another way than rays."""
    return lambda x, y: float(value_at(simulated.scene.height_m, simulated.scene.grid, x, y))


@pytest.fixture
def boulder(simulated):
    """x, y and z of the centre of the largest boulder."""
    boulders = simulated.scene.boulders
    k = int(np.argmax(boulders.diameter_m))
    return float(boulders.x_m[k]), float(boulders.y_m[k]), float(simulated.scene.boulder_z_m[k])


def items(client, reply, size=1):
    """Items of a reply, each of `size` floats and None if it is not valid."""
    assert client.number() == reply
    found = []
    for _ in range(client.number()):
        numbers = [as_float(client.read(4)) for _ in range(size)]
        found.append((numbers if size > 1 else numbers[0]) if client.read(1) == b"\1" else None)
    return found


def point(client):
    assert client.number() == 5
    numbers = [as_float(client.read(4)) for _ in range(3)]
    return numbers if client.read(1) == b"\1" else None


def set_view(client, *values):
    client.send("00000100" + floats(*values))
    assert client.number() == 0


def seen_range(height, origin, direction):
    """Range along a ray (not level) to the ground, by iteration on its heights."""
    direction = np.array(direction) / np.linalg.norm(direction)
    found = (origin[2] - height(*origin[:2])) / -direction[2]
    for _ in range(20):
        x, y, _ = origin + found * direction
        found = (origin[2] - height(x, y)) / -direction[2]
    return found


def pixel_ray(column, row):
    """Direction in the world of a pixel of a camera that looks straight down with +y on top, of length 1 along z."""
    per_pixel = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)) / (SIZE[0] / 2)
    return np.array([(column + 0.5 - SIZE[0] / 2) * per_pixel, -(row + 0.5 - SIZE[1] / 2) * per_pixel, -1.0])


def test_a_point_in_the_image_is_where_the_pixel_shows_it(client, height):
    client.send(f"00000100 {DOWN_1000}")
    assert client.number() == 0
    # The facts: LookupPoint(0.5, 0.25), below the middle of the image, so at negative y with +y on top.
    client.send("00000004 0000007e 0000007d")
    x, y, z = point(client)
    per_pixel = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2)) / (SIZE[0] / 2)
    assert abs(x) < 0.01
    assert np.isclose(y, -0.25 * SIZE[1] * per_pixel * (1000 - z), rtol=1e-5)
    assert abs(z - height(x, y)) < TOLERANCE_M
    client.send("00000006" + floats(0, 0, -2))
    assert [round(value, 2) for value in point(client)[:2]] == [0, 0]
    client.send("00000006" + floats(0, 0, 1))  # the sky
    assert point(client) is None


def test_lists_of_points_have_as_many_items_as_were_asked_for(client):
    for number, size, reply, item in ((3, 3, 4, 5), (5, 2, 6, 13), (7, 3, 6, 13)):
        client.send(f"{number:08x} 00000003" + floats(*[0.1, 0.2, -0.5][:size] * 3))
        assert client.number() == reply
        assert client.number() == 3
        client.read(3 * item)
        client.send(f"{number:08x} 00000000")
        assert [client.number(), client.number()] == [reply, 0]


def test_elevations_are_heights_over_the_ground(client, height):
    places = [(0, 0, 1000), (40, -25, 300), (-30, 60, 50), (1e5, 0, 1000), (0, 0, -50)]
    client.send("00000003 00000005" + "".join(floats(*place) for place in places))
    found = items(client, 4)
    for value, (x, y, z) in zip(found[:3], places[:3], strict=True):
        assert abs(value - (z - height(x, y))) < TOLERANCE_M
    assert found[3:] == [None, None]  # off the ground, and under it


def test_surface_patch_is_a_turned_grid_of_heights(client, height):
    client.send("00000019 00" + floats(20, -30) + "00000003 00000002" + floats(4, np.pi / 2))
    found = items(client, 4)
    # Turned by 90 degrees, local x is +y and local y is -x.
    expected = [height(20 - y, -30 + x) for y in (-2, 2) for x in (-4, 0, 4)]
    assert np.allclose(found, expected, rtol=0, atol=TOLERANCE_M)
    client.send("00000019 00" + floats(100, 50) + "00000003 00000002" + floats(40, 0.5))
    found = items(client, 4)
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [height(100 + c * x - s * y, 50 + s * x + c * y) for y in (-20, 20) for x in (-40, 0, 40)]
    assert np.std(expected) > 2 * TOLERANCE_M
    assert np.allclose(found, expected, rtol=0, atol=TOLERANCE_M)
    client.send("00000017 00" + floats(1e5, 0))
    assert client.number() == 3
    assert client.read(5)[-1] == 0


def test_surface_elevations_are_with_boulders_if_asked(client, height, boulder):
    x, y, z = boulder
    client.send("00000018 00 00000001" + floats(x, y))
    (ground,) = items(client, 4)
    client.send("00000018 01 00000001" + floats(x, y))
    (top,) = items(client, 4)
    assert abs(ground - height(x, y)) < TOLERANCE_M
    assert top > max(ground, z)


def test_a_lidar_pulse_has_range_and_cosine(client, height):
    client.send("0000000d" + floats(0, 0, 500, 0, 0, -3))
    assert client.number() == 9
    distance, cosine = (as_float(client.read(4)) for _ in range(2))
    assert abs(distance - 500) < 1
    assert 0.8 < cosine <= 1
    client.send("0000000d" + floats(0, 0, 500, 0, 0, 3))
    assert [client.number(), client.number(), client.number()] == [9, 0, 0]


def test_an_oblique_lidar_pulse(client, simulated, height):
    origin, target = np.array([120.0, 60.0, 300.0]), np.array([10.0, -20.0, height(10, -20)])
    way = target - origin
    client.send("0000000d" + floats(*origin, *(2 * way)))  # the direction's length is of no importance
    assert client.number() == 9
    distance, cosine = (as_float(client.read(4)) for _ in range(2))
    assert abs(distance - np.linalg.norm(way)) < 2 * TOLERANCE_M
    step = float(simulated.scene.grid.spacings_m[0])
    slope = [(height(10 + dx, -20 + dy) - height(10 - dx, -20 - dy)) / (2 * step) for dx, dy in ((step, 0), (0, step))]
    normal = np.array([-slope[0], -slope[1], 1]) / np.linalg.norm([*slope, 1])
    assert abs(cosine + normal @ way / np.linalg.norm(way)) < 0.1


def test_a_view_as_elevation_model_has_falling_rows(client, height):
    grid = "00000001 00 00000003 00000002" + floats(40, 30)
    set_view(client, 20, -30, 500, 0, -90, 0)
    client.send("0000001f" + grid + floats(500))
    expected = [height(20 + x, -30 + y) for y in (15, -15) for x in (-40, 0, 40)]
    assert np.std(expected) > 2 * TOLERANCE_M
    assert np.allclose(items(client, 4), expected, rtol=0, atol=TOLERANCE_M)
    set_view(client, 20, -30, 500, 90, -90, 0)  # right is +y, the top is -x
    client.send("0000001f" + grid + floats(100))
    expected = [height(20 - y, -30 + x) - 400 for y in (15, -15) for x in (-40, 0, 40)]
    assert np.allclose(items(client, 4), expected, rtol=0, atol=TOLERANCE_M)


def test_a_range_image_is_columns_of_the_range_texture(client, height):
    client.send("0000000a")
    assert client.number() == 2
    head = b"P6\n256 1 255\n"
    data = client.read(client.number())
    assert data == head + bytes(value for grey in range(256) for value in (grey, grey, grey))
    set_view(client, 0, 0, 1000, 0, -90, 0)
    offset, scale = 980, 1 / 130
    client.send("00000009" + floats(offset, scale))
    image = client.image()
    for column, row in ((0, 0), (63, 0), (0, 47), (63, 47), (32, 24), (10, 30)):
        expected = seen_range(height, np.array([0, 0, 1000.0]), pixel_ray(column, row))
        assert abs(int(image[row, column, 0]) - (expected - offset) * scale * 255) < 1.5
    for offset, grey in ((2000, 0), (-2000, 255)):
        client.send("00000009" + floats(offset, 1))
        assert (client.image() == grey).all()


def test_a_lidar_snapshot_is_plain_floats(client, height):
    client.send("00000023 00000000" + doubles(0, 0, 500, 0, 1, 0, 0))
    count = 12 * SIZE[0] * SIZE[1]
    assert [client.number() for _ in range(6)] == [17, 0, 0, *SIZE, count]
    data = struct.unpack(f">{count // 4}f", client.read(count))
    found = np.array(data).reshape(SIZE[1], SIZE[0], 3)
    for column, row in ((0, 0), (63, 0), (0, 47), (40, 12)):
        expected = seen_range(height, np.array([0, 0, 500.0]), pixel_ray(column, row))
        assert abs(found[row, column, 0] - expected) < 2 * TOLERANCE_M
    assert (found[..., 2] == 1).all()
    assert (found[..., 1] > 0).all() and (found[..., 1] <= 1).all() and found[..., 1].mean() > 0.9
    client.send("00000023 00000000" + doubles(0, 0, 500, 1, 0, 0, 0))  # the sky
    assert [client.number() for _ in range(6)] == [17, 0, 0, *SIZE, count]
    assert client.read(count) == bytes(count)


def test_rays_from_under_the_ground_hit_nothing(client):
    set_view(client, 0, 0, -50, 0, 90, 0)
    client.send("00000006" + floats(0, 0, 1))
    assert point(client) is None
    client.send("00000007 00000002" + floats(0, 0, 1, 0.3, 0.2, 1))
    assert items(client, 6, 3) == [None, None]
    client.send("00000004" + floats(0.5, 0.5))
    assert point(client) is None
    client.send("0000001f 00000001 00 00000002 00000002" + floats(1, 1, 0))
    assert items(client, 4) == [None] * 4
    client.send("00000002")
    assert client.number() == 3
    assert client.read(5)[-1] == 0
    client.send("0000000d" + floats(0, 0, -50, 0, 0, 1))
    assert [client.number(), client.number(), client.number()] == [9, 0, 0]


def test_rays_from_inside_a_boulder_hit_nothing(client, boulder):
    set_view(client, *boulder, 0, -90, 0)
    client.send("00000006" + floats(0, 0, -1))
    assert point(client) is None
    client.send("0000000d" + floats(*boulder, 0, 0, -1))
    assert [client.number(), client.number(), client.number()] == [9, 0, 0]
    client.send("0000001f 00000001 00 00000001 00000001" + floats(1, 1, 0))  # without boulders the ground is seen
    assert items(client, 4)[0] is not None


def test_the_back_of_the_ground_is_not_hit(client, simulated):
    beside = simulated.scene.grid.extent_m / 2 + 50 + abs(simulated.scene.grid.centre_x_m)
    client.send("0000000d" + floats(beside, 0, -200, -1, 0, 0.5))
    assert [client.number(), client.number(), client.number()] == [9, 0, 0]
