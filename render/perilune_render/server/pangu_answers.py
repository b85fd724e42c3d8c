"""The answer to each message of PANGU's protocol.

`answer` is called in the thread of the world. Errors are answers too.
"""

from collections.abc import Callable

import numpy as np

from perilune_render.server import pangu_messages as m
from perilune_render.server.pangu_session import Session, picture
from perilune_render.server.pangu_view import (
    camera_from_angles,
    rotation_from_angles,
    rotation_from_quaternion,
    sun_from_angles,
)
from perilune_render.server.pangu_wire import double_bytes, float_bytes, text_bytes, unsigned
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, quaternion_from_matrix

RANGE_WIDTH = 256
"""Pixels of the range texture, which is a ramp of grey values."""
REFUSED, FAULTY = 1, 2
"""Codes of errors: a request that this server does not simulate, and one with impossible values."""
_CAMERAS = (0, 1)
_MOST_HEIGHTS = 1_000_000
_LARGEST = 1e16
"""Largest number in a message: the Sun's distance may be 1e15 metres."""


def answer(session: Session, message: m.Message, values: list, items: Array | bytes) -> bytes:
    """The reply to a message with the values of its fields and its array."""
    try:
        if message.effect == "refused":
            return error(REFUSED, f"{message.name}: {message.note}")
        if message.effect == "read":
            return unsigned(m.OKAY)
        _check(values, items)
        made = _ANSWERS[message.number](session, values, items)
        return unsigned(m.OKAY) if made is None else made
    except UserError as fault:
        return error(FAULTY, f"{message.name}: {fault}")
    except ValueError as fault:
        return error(FAULTY, f"{message.name}: got {fault}")


def _check(values: list, items: Array | bytes) -> None:
    """Raise ValueError for numbers that are not finite, or too large."""
    numbers = np.array([value for value in values if isinstance(value, float)])
    for part in (numbers, items):
        if not isinstance(part, bytes) and not (np.abs(part) <= _LARGEST).all():
            raise ValueError(f"a number that is not finite, or beyond {_LARGEST:g}")


def error(code: int, text: str) -> bytes:
    """An error as a message."""
    return unsigned(m.ERROR, code) + text_bytes(text[:900] or "error")


def _valid_floats(values: Array) -> bytes:
    """Floats, each with a bool that says whether it is valid (finite)."""
    good = np.isfinite(values)
    words = float_bytes(np.where(good, values, 0.0))
    return b"".join(words[4 * k : 4 * k + 4] + (b"\1" if good[k] else b"\0") for k in range(len(values)))


def _valid_points(points: Array) -> bytes:
    """Points (N, 3), each with a bool that says whether it is valid (finite)."""
    good = np.isfinite(points).all(axis=1)
    words = float_bytes(np.where(good[:, None], points, 0.0).ravel())
    return b"".join(words[12 * k : 12 * k + 12] + (b"\1" if good[k] else b"\0") for k in range(len(points)))


def _doubles(values: Array, *, valid: bool) -> bytes:
    words = double_bytes(values)
    return b"".join(words[8 * k : 8 * k + 8] + (b"\1" if valid else b"\0") for k in range(len(values)))


def _float_array(values: Array) -> bytes:
    return unsigned(m.FLOAT_ARRAY, len(values)) + _valid_floats(values)


def _viewpoint(session: Session, values: list, scale: float) -> None:
    session.position_m = np.array(values[:3])
    yaw, pitch, roll = np.array(values[3:]) * scale
    session.rotation_camera_from_site = rotation_from_angles(yaw, pitch, roll, session.conventions.roll_sense)


def _by_degrees(session: Session, values: list, items: object) -> None:
    _viewpoint(session, values, np.pi / 180)


def _by_radians(session: Session, values: list, items: object) -> None:
    _viewpoint(session, values, 1.0)


def _by_quaternion(session: Session, values: list, items: object) -> None:
    rotation = rotation_from_quaternion(np.array(values[3:]))
    session.position_m, session.rotation_camera_from_site = np.array(values[:3]), rotation


def _imaged(set_view: Callable) -> Callable:
    def imaged(session: Session, values: list, items: object) -> bytes:
        set_view(session, values, items)
        return session.image()

    return imaged


def _elevations(session: Session, places: Array) -> Array:
    distance, _ = session.world.hits(places, np.tile([0.0, 0.0, -1.0], (len(places), 1)))
    return distance


def _points(session: Session, directions: Array) -> Array:
    """Points (N, 3) of the surface seen from the camera in directions (N, 3) of the world; infinite where none is."""
    if (np.linalg.norm(directions, axis=1) == 0).any():
        raise ValueError("a direction of length 0")
    distance, _ = session.world.hits(np.tile(session.position_m, (len(directions), 1)), directions)
    with np.errstate(invalid="ignore"):
        return session.position_m + distance[:, None] * directions


def _looked_up(session: Session, places: Array) -> Array:
    """Points (N, 3) in places (N, 2) of the image: (0, 0) is its bottom left corner, (1, 1) the top right one."""
    view = session.view()
    pixels = np.stack([places[:, 0] * session.width_px, (1 - places[:, 1]) * session.height_px], axis=1)
    found = _points(session, view.camera.rays(pixels) @ view.rotation_camera_from_site)
    outside = ((places < 0) | (places > 1)).any(axis=1)
    return np.where(outside[:, None], np.inf, found)


def _pulse(session: Session, values: list, items: object) -> bytes:
    origin, direction = np.array(values[:3]), np.array(values[3:])
    length = np.linalg.norm(direction)
    if length == 0:
        raise ValueError("a direction of length 0")
    distance, normal = session.world.hits(origin[None], direction[None])
    hit = np.isfinite(distance[0])
    found = [distance[0] * length, abs(float(normal[0] @ direction)) / length] if hit else [0.0, 0.0]
    return unsigned(m.LIDAR_PULSE) + float_bytes(found)


def _surface(session: Session, boulders: bool, places: Array) -> Array:
    return session.world.heights_m(places[:, 0], places[:, 1], boulders=boulders)


def _grid(nx: int, ny: int, dx: float, dy: float) -> tuple[Array, Array]:
    """Places (ny, nx) on a grid about 0. Raises ValueError if there are none or too many."""
    if not 1 <= nx * ny <= _MOST_HEIGHTS:
        raise ValueError(f"{nx} x {ny} heights, expected 1 to {_MOST_HEIGHTS}")
    x, y = np.meshgrid((np.arange(nx) - (nx - 1) / 2) * dx, (np.arange(ny) - (ny - 1) / 2) * dy)
    return x, y


def _patch(session: Session, values: list, items: object) -> bytes:
    boulders, cx, cy, nx, ny, spacing, angle = values
    x, y = _grid(nx, ny, spacing, spacing)
    c, s = np.cos(angle), np.sin(angle)
    places = np.stack([cx + c * x - s * y, cy + s * x + c * y], axis=-1).reshape(-1, 2)
    return _float_array(_surface(session, boulders, places))


def _view_as_dem(session: Session, values: list, items: object) -> bytes:
    camera, boulders, nx, ny, dx, dy, reference = values
    world = session.world
    if camera != 1:
        raise ValueError(f"camera {camera}, expected 1")
    x, y = _grid(nx, ny, dx, -dy)
    across, down, forward = session.rotation_camera_from_site
    origins = session.position_m + x[..., None] * across - y[..., None] * down
    rays = np.tile(forward, (nx * ny, 1))
    distance, _ = world.hits(origins.reshape(-1, 3), rays, boulders=boulders)
    return _float_array(reference - distance)


def _range_image(session: Session, values: list, items: object) -> bytes:
    offset, scale = values
    radiance = session.world.radiance(session.view())
    camera = session.view().camera
    ranges = radiance.depth_m * np.linalg.norm(camera.rays(camera.pixel_centres()), axis=-1)
    share = np.clip((ranges - offset) * scale, 0, 1) if scale else np.zeros_like(ranges)
    return picture(np.floor(share * (RANGE_WIDTH - 1) + 0.5).astype(np.uint8))


def _properties(session: Session, values: list, items: object) -> bytes:
    if values[0] not in _CAMERAS:
        return unsigned(m.CAMERA, 0)
    camera = session.view().camera
    vertical = 2 * np.arctan(camera.height_px / 2 / camera.fy_px)
    q = quaternion_from_matrix(session.rotation_camera_from_site.T)
    numbers = double_bytes([session.field_of_view_rad, vertical, *session.position_m, *q])
    return unsigned(m.CAMERA, 80, camera.width_px, camera.height_px) + numbers


def _snapshot(session: Session, values: list, items: object) -> bytes:
    if values[0] not in _CAMERAS:
        raise ValueError(f"camera {values[0]}, expected 0 or 1")
    position, rotation = np.array(values[1:4]), rotation_from_quaternion(np.array(values[4:]))
    camera = session.view().camera
    rays = camera.rays(camera.pixel_centres()).reshape(-1, 3) @ rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    session.world.check(position)
    distance, normal = session.world.hits(np.tile(position, (len(rays), 1)), rays)
    hit = np.isfinite(distance)
    cosine = np.abs(np.einsum("ij,ij->i", normal, rays))
    data = np.stack([np.where(hit, distance, 0.0), cosine, hit], axis=1).astype(">f4").tobytes()
    return unsigned(m.RAW_IMAGE, 0, 0, camera.width_px, camera.height_px, len(data)) + data


def _field_of_view(session: Session, angle_rad: float) -> None:
    camera_from_angles(session.width_px, session.height_px, angle_rad, session.aspect)
    session.field_of_view_rad = angle_rad


def _aspect(session: Session, values: list, items: object) -> None:
    camera_from_angles(session.width_px, session.height_px, session.field_of_view_rad, values[0])
    session.aspect = values[0]


def _sun(session: Session, azimuth_rad: float, elevation_rad: float) -> None:
    session.sun = sun_from_angles(azimuth_rad, elevation_rad, session.conventions.sun_zero)


def _select(session: Session, values: list, items: object) -> None:
    if values[0] not in _CAMERAS:
        raise ValueError(f"camera {values[0]}, expected 0 or 1")


def _projection(session: Session, values: list, items: object) -> None:
    if values[1] != 0:
        raise ValueError(f"projection {values[1]}, expected 0, perspective")


def _motion(session: Session, values: list, items: object) -> None:
    session.velocity_mps = np.array(values[1:4])


def _time_tag(session: Session, values: list, items: object) -> bytes:
    valid = session.time_tag_us is not None
    return unsigned(m.DOUBLE) + _doubles(np.array([session.time_tag_us or 0.0]), valid=valid)


def _camera_image(session: Session, values: list, items: object) -> bytes:
    return session.image() if values[0] in _CAMERAS else unsigned(m.IMAGE, 0)


def _zeros(n: int) -> Callable:
    return lambda session, values, items: unsigned(m.DOUBLE_ARRAY, n) + _doubles(np.zeros(n), valid=False)


_ANSWERS: dict[int, Callable] = {
    1: lambda s, v, i: s.image(),
    2: lambda s, v, i: unsigned(m.FLOAT) + _valid_floats(_elevations(s, s.position_m[None])),
    3: lambda s, v, i: _float_array(_elevations(s, i)),
    4: lambda s, v, i: unsigned(m.POINT) + _valid_points(_looked_up(s, np.array([v]))),
    5: lambda s, v, i: unsigned(m.POINT_ARRAY, len(i)) + _valid_points(_looked_up(s, i)),
    6: lambda s, v, i: unsigned(m.POINT) + _valid_points(_points(s, np.array([v]))),
    7: lambda s, v, i: unsigned(m.POINT_ARRAY, len(i)) + _valid_points(_points(s, i)),
    8: lambda s, v, i: unsigned(m.ECHO, len(i)) + i,
    9: _range_image,
    10: lambda s, v, i: picture(np.arange(RANGE_WIDTH, dtype=np.uint8)[None]),
    11: _imaged(_by_degrees),
    12: _imaged(_by_quaternion),
    13: _pulse,
    16: _imaged(_by_degrees),
    17: _imaged(_by_quaternion),
    18: lambda s, v, i: unsigned(m.JOINTS, 0),
    19: _zeros(9),
    20: lambda s, v, i: unsigned(m.FRAMES, 0),
    21: _zeros(12),
    22: _zeros(6),
    23: lambda s, v, i: unsigned(m.FLOAT) + _valid_floats(_surface(s, v[0], np.array([v[1:]]))),
    24: lambda s, v, i: _float_array(_surface(s, v[0], i)),
    25: _patch,
    26: _imaged(_by_radians),
    28: lambda s, v, i: unsigned(m.IMAGE, 0),
    29: _properties,
    30: _camera_image,
    31: _view_as_dem,
    33: _time_tag,
    35: _snapshot,
    256: _by_degrees,
    257: _by_quaternion,
    261: lambda s, v, i: _field_of_view(s, np.radians(v[0])),
    262: _aspect,
    268: _by_degrees,
    269: _by_quaternion,
    271: lambda s, v, i: _sun(s, np.radians(v[1]), np.radians(v[2])),
    278: _by_radians,
    279: lambda s, v, i: _field_of_view(s, v[0]),
    280: lambda s, v, i: _sun(s, v[1], v[2]),
    288: _select,
    296: _projection,
    299: _motion,
}
"""What is done for each message that has an effect, by its number."""
