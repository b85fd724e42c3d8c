"""Answer the messages of PANGU's protocol. Runs in the thread that renders."""

from collections.abc import Callable

import numpy as np

from perilune_render.flight.pose_checks import LARGEST_MPS
from perilune_render.server.pangu import measures
from perilune_render.server.pangu import messages as m
from perilune_render.server.pangu.session import CAMERAS, Session, check_camera
from perilune_render.server.pangu.view import (
    camera_from_angles,
    rotation_from_angles,
    rotation_from_quaternion,
    sun_from_angles,
)
from perilune_render.server.pangu.wire import (
    FAULTY,
    REFUSED,
    double_bytes,
    doubles,
    error,
    float_array,
    unsigned,
    valid_floats,
    valid_points,
)
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, quaternion_from_matrix

_LARGEST = 1e16
"""Largest accepted number in a message; the distance of the Sun may be 1e15 metres."""


def answer(session: Session, message: m.Message, values: list, items: Array | bytes) -> bytes:
    """The reply to a message, given the values of its fields and its array. Errors are replies too."""
    try:
        if message.effect == "refused":
            return error(REFUSED, f"{message.name}: {message.note}")
        if message.effect == "read":
            return unsigned(m.OKAY)
        _check(values, items)
        payload = _ANSWERS[message.number](session, values, items)
        return unsigned(m.OKAY) if payload is None else payload
    except UserError as fault:
        return error(FAULTY, f"{message.name}: {fault}")
    except ValueError as fault:
        return error(FAULTY, f"{message.name}: got {fault}")
    except ArithmeticError as fault:
        return error(FAULTY, f"{message.name}: got values that cannot be computed with ({fault})")


def _check(values: list, items: Array | bytes) -> None:
    """Raise ValueError for numbers that are not finite, or too large."""
    numbers = np.array([value for value in values if isinstance(value, float)])
    for part in (numbers, items):
        if not isinstance(part, bytes) and not (np.abs(part) <= _LARGEST).all():
            raise ValueError(f"a number that is not finite, or beyond {_LARGEST:g}")


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


def _properties(session: Session, values: list, items: object) -> bytes:
    if values[0] not in CAMERAS:
        return unsigned(m.CAMERA, 0)
    camera = session.view().camera
    vertical = 2 * np.arctan(camera.height_px / 2 / camera.fy_px)
    q = quaternion_from_matrix(session.rotation_camera_from_site.T)
    numbers = double_bytes([session.field_of_view_rad, vertical, *session.position_m, *q])
    return unsigned(m.CAMERA, 80, camera.width_px, camera.height_px) + numbers


def _field_of_view(session: Session, angle_rad: float) -> None:
    camera_from_angles(session.width_px, session.height_px, angle_rad, session.aspect)
    session.field_of_view_rad = angle_rad


def _aspect(session: Session, values: list, items: object) -> None:
    camera_from_angles(session.width_px, session.height_px, session.field_of_view_rad, values[0])
    session.aspect = values[0]


def _sun(session: Session, azimuth_rad: float, elevation_rad: float) -> None:
    session.sun = sun_from_angles(azimuth_rad, elevation_rad, session.conventions.sun_zero)


def _select(session: Session, values: list, items: object) -> None:
    check_camera(values[0])


def _projection(session: Session, values: list, items: object) -> None:
    check_camera(values[0])
    if values[1] != 0:
        raise ValueError(f"projection {values[1]}, expected 0, perspective")


def _motion(session: Session, values: list, items: object) -> None:
    check_camera(values[0])
    velocity = np.array(values[1:4])
    speed_mps = float(np.linalg.norm(velocity))
    if speed_mps > LARGEST_MPS:
        raise ValueError(f"a velocity of {speed_mps:g} m/s, expected at most {LARGEST_MPS:g}")
    session.velocity_mps = velocity


def _time_tag(session: Session, values: list, items: object) -> bytes:
    valid = session.time_tag_us is not None
    return unsigned(m.DOUBLE) + doubles(np.array([session.time_tag_us or 0.0]), valid=valid)


def _camera_image(session: Session, values: list, items: object) -> bytes:
    return session.image() if values[0] in CAMERAS else unsigned(m.IMAGE, 0)


def _zeros(n: int) -> Callable:
    return lambda session, values, items: unsigned(m.DOUBLE_ARRAY, n) + doubles(np.zeros(n), valid=False)


_ANSWERS: dict[int, Callable] = {
    1: lambda s, v, i: s.image(),
    2: lambda s, v, i: unsigned(m.FLOAT) + valid_floats(measures.elevations(s, s.position_m[None])),
    3: lambda s, v, i: float_array(measures.elevations(s, i)),
    4: lambda s, v, i: unsigned(m.POINT) + valid_points(measures.looked_up(s, np.array([v]))),
    5: lambda s, v, i: unsigned(m.POINT_ARRAY, len(i)) + valid_points(measures.looked_up(s, i)),
    6: lambda s, v, i: unsigned(m.POINT) + valid_points(measures.points(s, np.array([v]))),
    7: lambda s, v, i: unsigned(m.POINT_ARRAY, len(i)) + valid_points(measures.points(s, i)),
    8: lambda s, v, i: unsigned(m.ECHO, len(i)) + i,
    9: measures.range_image,
    10: measures.range_texture,
    11: _imaged(_by_degrees),
    12: _imaged(_by_quaternion),
    13: measures.pulse,
    16: _imaged(_by_degrees),
    17: _imaged(_by_quaternion),
    18: lambda s, v, i: unsigned(m.JOINTS, 0),
    19: _zeros(9),
    20: lambda s, v, i: unsigned(m.FRAMES, 0),
    21: _zeros(12),
    22: _zeros(6),
    23: lambda s, v, i: unsigned(m.FLOAT) + valid_floats(measures.surface(s, v[0], np.array([v[1:]]))),
    24: lambda s, v, i: float_array(measures.surface(s, v[0], i)),
    25: measures.patch,
    26: _imaged(_by_radians),
    28: lambda s, v, i: unsigned(m.IMAGE, 0),
    29: _properties,
    30: _camera_image,
    31: measures.view_as_dem,
    33: _time_tag,
    35: measures.snapshot,
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
"""Function that answers each message of effect `answered`, by message number."""
