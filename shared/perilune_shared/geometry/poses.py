"""Create camera poses from altitude and tilt, from a target to look at, or along a descent.

    look_down(altitude_m=800, tilt_deg=10)
    look_at(position_m=(300, 0, 500), target_m=(0, 0, 0))
    descent(n_frames=20)

Positions are in O_L: x west, y south, z up, metres; the site is at (0, 0, 0). Azimuths are clockwise from north.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Position, rotation and velocity of a camera."""

    position_m: Array
    """Position (3,), O_L, metres."""
    rotation_camera_from_site: Array
    """Rotation matrix (3, 3); O_C has x to the right of the image, y down and z along the line of sight."""
    velocity_mps: Array
    """Velocity (3,), O_L, metres per second; causes motion blur."""

    @property
    def rotation_wxyz(self) -> Array:
        """The rotation as a quaternion (4,), as in the table `frames`."""
        return quaternion_from_matrix(self.rotation_camera_from_site)

    @property
    def tilt_deg(self) -> float:
        """Angle of the line of sight from straight down, degrees."""
        return math.degrees(math.acos(min(max(-float(self.rotation_camera_from_site[2, 2]), -1.0), 1.0)))

    def __repr__(self) -> str:
        x, y, z = self.position_m.tolist()
        speed = float(np.linalg.norm(self.velocity_mps))
        moving = f", {speed:g} m/s" if speed else ""
        return f"Pose(x {x:.1f} m west, y {y:.1f} m south, z {z:.1f} m up, tilt {self.tilt_deg:.1f} degrees{moving})"


def look_down(altitude_m: float, tilt_deg: float = 0.0, azimuth_deg: float = 0.0) -> Pose:
    """Return the pose of a camera above the site that looks down, with an optional tilt.

    `altitude_m` is the height above the site. The line of sight is tilted by `tilt_deg` (0 to 180) from straight down
    towards `azimuth_deg`. The top of the image points towards `azimuth_deg` too, so by default north is up. Raises
    UserError on values out of range.

        pose = look_down(altitude_m=800, tilt_deg=10)
    """
    _check("look_down", "altitude_m", altitude_m, 1e-3, 1e9)
    _check("look_down", "tilt_deg", tilt_deg, 0, 180)
    _check("look_down", "azimuth_deg", azimuth_deg, -720, 720)
    position = np.array([0.0, 0.0, float(altitude_m)])
    return Pose(position, _rotation(math.radians(tilt_deg), math.radians(azimuth_deg)), np.zeros(3))


def look_at(position_m: ArrayLike, target_m: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
    """Return the pose of a camera at `position_m` that looks at `target_m`, both (3,), O_L, metres.

    The top of the image shows the ground that is farthest from the camera. If the camera looks straight down, north is
    up. Raises UserError if position and target are equal, or if one of them is not three finite numbers.

        pose = look_at(position_m=(300, 0, 500))
    """
    position, target = _position("position_m", position_m), _position("target_m", target_m)
    west, south, up = (target - position).tolist()
    away = math.hypot(west, south)
    if away == 0 and up == 0:
        raise UserError("look_at", "target_m", target.tolist(), "a point other than position_m")
    azimuth = math.atan2(-west, -south) if away else 0.0
    return Pose(position, _rotation(math.atan2(away, -up), azimuth), np.zeros(3))


def descent(
    n_frames: int,
    *,
    start_altitude_m: float = 1500.0,
    end_altitude_m: float = 200.0,
    downrange_m: float = 500.0,
    azimuth_deg: float = 0.0,
    duration_s: float = 65.0,
) -> list[Pose]:
    """Return poses, with velocities, along a parabola that ends above the site.

    A dataset without perturbations has such poses (`NominalTrajectory.parabola`): the camera looks straight
    down, and south is up in the images. The trajectory starts `downrange_m` from the site, in the direction
    `azimuth_deg`. Frames are evenly spaced in time. Raises UserError on values out of range.

        poses = descent(n_frames=20, start_altitude_m=1000)
    """
    if isinstance(n_frames, bool) or not isinstance(n_frames, int) or not 2 <= n_frames <= 1_000_000:
        raise UserError("descent", "n_frames", n_frames, "a whole number of frames, 2 to 1000000")
    _check("descent", "start_altitude_m", start_altitude_m, 1e-3, 1e9)
    _check("descent", "end_altitude_m", end_altitude_m, 1e-3, 1e9)
    _check("descent", "downrange_m", downrange_m, 0, 1e6)
    _check("descent", "azimuth_deg", azimuth_deg, -720, 720)
    _check("descent", "duration_s", duration_s, 1e-3, 1e6)
    path = NominalTrajectory.parabola(start_altitude_m, end_altitude_m, downrange_m, azimuth_deg, duration_s)
    time_s = np.linspace(0.0, duration_s, n_frames)
    down = _rotation(0.0, math.pi)
    moves = zip(path.position_at(time_s), path.velocity_at(time_s), strict=True)
    return [Pose(position, down, velocity) for position, velocity in moves]


def _rotation(tilt_rad: float, azimuth_rad: float) -> Array:
    """Return rotation_camera_from_site (3, 3) for a line of sight at a tilt towards an azimuth."""
    sine, cosine = math.sin(azimuth_rad), math.cos(azimuth_rad)
    sight = np.array([-sine * math.sin(tilt_rad), -cosine * math.sin(tilt_rad), -math.cos(tilt_rad)])
    right = np.array([-cosine, sine, 0.0])
    return np.stack([right, np.cross(sight, right), sight])


def _check(where: str, field: str, value: float, low: float, high: float) -> None:
    """Raise UserError unless a value is a number from `low` to `high`."""
    is_number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:
        raise UserError(where, field, value, f"a number from {low:g} to {high:g}")


def _position(field: str, value: ArrayLike) -> Array:
    """Return a position as an array (3,). Raises UserError on anything but three finite numbers."""
    try:
        values = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise UserError("look_at", field, value, "x, y and z in O_L, metres")
    return values


def listed(poses: Pose | Sequence[Pose]) -> list[Pose]:
    """Return one pose or several as a list. Raises UserError on anything else."""
    listed_poses: list[Any] = list(poses) if isinstance(poses, Sequence) and not isinstance(poses, str) else [poses]
    for each in listed_poses:
        if not isinstance(each, Pose):
            raise UserError("render", "pose", repr(each), "look_down(...), look_at(...), or a list of poses")
    return listed_poses
