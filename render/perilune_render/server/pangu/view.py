"""PANGU's conventions for viewpoints, with options where the convention is unknown.

The world is right-handed with z up; here it is O_L. The camera has x to the right, y down and z forward. Yaw 0 and
pitch 0 look along +y; positive yaw turns to the left, negative pitch looks down. docs/reference/pangu.md states which
of these conventions were observed in a client and which are deduced.
"""

from typing import Literal

import numpy as np

from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion

SunZero = Literal["clockwise-from-y", "anticlockwise-from-x"]
"""How the Sun's azimuth is counted, seen from above: sense and zero direction. PANGU's convention is unknown."""
RollSense = Literal["left", "right"]
"""Side to which positive roll leans the top of the camera; PANGU's convention is unknown."""


def rotation_from_angles(yaw_rad: float, pitch_rad: float, roll_rad: float, roll_sense: RollSense = "left") -> Array:
    """rotation_camera_from_site (3, 3) of a viewpoint: qz(yaw) qx(pitch - 90 degrees) qz(-roll), transposed."""
    roll = -roll_rad if roll_sense == "left" else roll_rad
    return (_about_z(yaw_rad) @ _about_x(pitch_rad - np.pi / 2) @ _about_z(roll)).T


def rotation_from_quaternion(q: Array) -> Array:
    """rotation_camera_from_site (3, 3) of a quaternion (4,), scalar first, that rotates camera vectors to the world.

    The quaternion may have any length but 0. Raises ValueError for length 0.
    """
    if np.linalg.norm(q) < 1e-6:
        raise ValueError("a quaternion of length 0")
    return matrix_from_quaternion(q).T


def sun_from_angles(azimuth_rad: float, elevation_rad: float, zero: SunZero) -> Array:
    """Unit vector (3,) towards the Sun in the world."""
    c = np.cos(elevation_rad)
    x, y = np.sin(azimuth_rad), np.cos(azimuth_rad)
    if zero == "anticlockwise-from-x":
        x, y = y, x
    return np.array([x * c, y * c, np.sin(elevation_rad)])


def camera_from_angles(width_px: int, height_px: int, field_of_view_rad: float, aspect: float) -> Camera:
    """A pinhole camera with a horizontal field of view.

    `aspect` is the height of a pixel divided by its width, both at depth 1. Raises ValueError if the field of view is
    not between 0.01 and 170 degrees, or if `aspect` is not between 0.1 and 10.
    """
    if not np.radians(0.01) <= field_of_view_rad <= np.radians(170):
        raise ValueError(f"a field of view of {np.degrees(field_of_view_rad):g} degrees")
    if not 0.1 <= aspect <= 10:
        raise ValueError(f"an aspect ratio of {aspect:g}")
    focal = width_px / 2 / np.tan(field_of_view_rad / 2)
    return Camera(width_px, height_px, float(focal), float(focal / aspect), width_px / 2, height_px / 2)


def _about_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _about_x(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
