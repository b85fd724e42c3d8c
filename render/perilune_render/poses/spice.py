"""Poses and Sun from SPICE kernels, in O_L of a site.

SPICE: Acton et al. 2018, doi 10.1016/j.pss.2017.02.013. O_L is taken as a rigid frame fixed to the Moon: its origin is
the site, its axes point west, south and up at the site. Position, velocity and attitude are converted by the same
rotation. Deviation: without `dataset.scene.horizon` the rendered ground is a plane, and the Moon falls away from it by
d^2 / 2R at a distance d from the site (0.3 m at 1 km, 1.2 m at 2 km, 29 m at 10 km).

Kernels are untrusted data: SPICE reads them and executes nothing. A meta-kernel names other files, which are checked
before SPICE opens them.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from perilune_render.poses.axes import camera_axes
from perilune_render.poses.kernels import library, loaded, reported
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import MOON_RADIUS_M, Array, quaternion_from_matrix

_MOON = "MOON"
_FIXED_FRAMES = ("MOON_ME", "IAU_MOON")
"""Frames fixed to the Moon in order of preference: the first that the kernels define is used."""
_MAX_FRAMES = 100_000
_LOADING_LIMIT_S = 60.0
"""Time limit for opening all kernels, seconds: a file replaced by a pipe after the check would block for ever."""
_LOADED = "loaded"


@dataclass(frozen=True, slots=True)
class SpiceSource:
    """What to read from kernels."""

    kernels: tuple[Path, ...]
    """Kernels and meta-kernels; later ones override earlier ones."""
    spacecraft: str
    """Name or NAIF id of the spacecraft, or of its camera if the kernels have the camera's position."""
    camera_frame: str
    """Name of the camera's frame."""
    camera_axes: str
    """Axes of this frame that point right, down and forward in the image, such as `x,y,z` or `-y,x,z`."""
    fixed_frame: str | None
    """Frame fixed to the Moon; None for the first of MOON_ME and IAU_MOON that the kernels define."""
    start: str
    """UTC of the first frame."""
    end: str
    """UTC of the end; the last frame is at or before it."""
    n_frames: int | None
    """Number of frames, evenly spaced from start to end."""
    step_s: float | None
    """Time between frames, seconds, in place of `n_frames`."""


@dataclass(frozen=True, slots=True)
class SpicePoses:
    """Poses of N frames from kernels."""

    time_s: Array
    """Time since the first frame, seconds (N,)."""
    position_m: Array
    """Position in O_L, metres (N, 3)."""
    rotation_wxyz: Array
    """rotation_camera_from_site as unit quaternions (N, 4)."""
    velocity_mps: Array
    """Velocity relative to the ground, O_L, metres per second (N, 3)."""
    angular_velocity_radps: Array | None
    """Angular velocity of the camera relative to the ground, O_C, radians per second (N, 3); None if the
    kernels lack it."""
    sun_deg: Array
    """Apparent azimuth and elevation of the Sun at the site, degrees (N, 2)."""
    start: str
    """UTC of the first frame, ISO 8601."""
    fixed_frame: str
    """Frame fixed to the Moon that was used."""


def rotation_site_from_fixed(latitude_deg: float, longitude_deg: float) -> Array:
    """Rotation (3, 3) from Moon-fixed axes (x towards 0 N 0 E, z north) to the axes of O_L at a site."""
    (sin_lat, cos_lat), (sin_lon, cos_lon) = ((np.sin(a), np.cos(a)) for a in np.radians([latitude_deg, longitude_deg]))
    west = [sin_lon, -cos_lon, 0.0]
    south = [sin_lat * cos_lon, sin_lat * sin_lon, -cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return np.array([west, south, up])


def read_spice(source: SpiceSource, latitude_deg: float, longitude_deg: float, site_height_m: float) -> SpicePoses:
    """Poses and velocities of a spacecraft, and the Sun's direction, at a site.

    The site is `site_height_m` above the sphere of radius 1737.4 km.

    Camera poses are geometric, without light time. The Sun is apparent (light time and stellar aberration, "LT+S") and
    seen from the site. SPICE runs in a separate process, since damaged kernels can crash it. Raises UserError if
    spiceypy is not installed, for an unreadable kernel, an unknown body or frame, a time without data, or a Sun below
    the plane.
    """
    library()
    context = get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sending, source, latitude_deg, longitude_deg, site_height_m))
    process.start()
    sending.close()
    names = ", ".join(path.name for path in source.kernels)
    try:
        if not receiving.poll(_LOADING_LIMIT_S):
            found = f"no result after {_LOADING_LIMIT_S:g} s of reading {names}"
            raise UserError("SPICE", "kernels", found, "kernels that are local files")
        result = receiving.recv()
        if result == _LOADED:
            result = receiving.recv()
    except EOFError:
        raise UserError("SPICE", "kernels", f"a crash while reading {names}", "undamaged kernels") from None
    finally:
        process.kill()
        process.join()
        receiving.close()
    if isinstance(result, SpicePoses):
        return result
    raise result


def _send(sending: Connection, source: SpiceSource, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    """Send _LOADED, then the poses or the error; runs in a separate process."""
    # The parent ends this process after Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        sending.send(_read(source, latitude_deg, longitude_deg, height_m, lambda: sending.send(_LOADED)))
    except Exception as error:
        sending.send(error)


def _read(
    source: SpiceSource,
    latitude_deg: float,
    longitude_deg: float,
    site_height_m: float,
    tell_loaded: Callable[[], None],
) -> SpicePoses:
    """Do the work of `read_spice` in this process. Calls `tell_loaded` after all kernels are open."""
    spice = library()
    axes = camera_axes(source.camera_axes, "--camera-axes")
    site_from_fixed = rotation_site_from_fixed(latitude_deg, longitude_deg)
    site_km = (MOON_RADIUS_M + site_height_m) / 1000 * site_from_fixed[2]
    with loaded(spice, source.kernels):
        tell_loaded()
        times = _times(spice, source)
        fixed = _fixed_frame(spice, source.fixed_frame)
        _check_frame(spice, "--camera-frame", source.camera_frame)
        spacecraft = _body(spice, source.spacecraft)
        rows, turns = [], []
        for et in times:
            with reported(spice, f"at {_utc(spice, et)}"):
                state = spice.spkezr(spacecraft, et, fixed, "NONE", _MOON)[0]
                rotation_camera_from_site = axes @ spice.pxform(fixed, source.camera_frame, et) @ site_from_fixed.T
                sun = spice.spkcpo("SUN", et, fixed, "OBSERVER", "LT+S", site_km, _MOON, fixed)[0][:3]
            rows.append(
                (
                    1000 * site_from_fixed @ (state[:3] - site_km),
                    rotation_camera_from_site,
                    1000 * site_from_fixed @ state[3:],
                    sun,
                )
            )
            turns.append(_angular_velocity_radps(spice, fixed, source.camera_frame, et, axes))
            _refuse_night(site_from_fixed @ sun, _utc(spice, et))
        start = _utc(spice, times[0])
    position, rotation, velocity, sun = (np.array(column) for column in zip(*rows, strict=True))
    quaternions = np.stack([quaternion_from_matrix(each) for each in rotation])
    towards = sun @ site_from_fixed.T
    sun_deg = np.degrees(
        [
            np.arctan2(-towards[:, 0], -towards[:, 1]) % (2 * np.pi),
            np.arcsin(towards[:, 2] / np.linalg.norm(towards, axis=1)),
        ]
    ).T
    known = [turn for turn in turns if turn is not None]
    turn = np.array(known) if len(known) == len(turns) else None
    return SpicePoses(times - times[0], position, quaternions, velocity, turn, sun_deg, start, fixed)


def _angular_velocity_radps(spice: Any, fixed: str, camera_frame: str, et: float, axes: Array) -> Array | None:
    """Angular velocity (3,) of a camera's axes relative to the fixed frame, in the camera's axes.

    Returns None without data.
    """
    try:
        rotation, turn = spice.xf2rav(spice.sxform(fixed, camera_frame, et))
    except spice.exceptions.SpiceyError:
        return None  # a CK without angular velocities; the attitude itself was read before
    return axes @ rotation @ turn


def poses_csv(
    poses: SpicePoses, source: SpiceSource, latitude_deg: float, longitude_deg: float, height_m: float
) -> str:
    """The poses as a CSV that `perilune_render.poses.file.read_poses` reads, with all digits."""
    kernels = ", ".join(path.name for path in source.kernels)
    lines = [
        "# frame: O_L",
        f"# site: {latitude_deg!r} {longitude_deg!r}",
        f"# height of the site above 1737.4 km: {height_m!r} m",
        f"# start: {poses.start} UTC",
        f"# {source.spacecraft}, {source.camera_frame} relative to {poses.fixed_frame}; kernels {kernels}",
    ]
    names = "time_s,x_m,y_m,z_m,qw,qx,qy,qz,vx_mps,vy_mps,vz_mps,sun_azimuth_deg,sun_elevation_deg"
    columns = [poses.time_s[:, None], poses.position_m, poses.rotation_wxyz, poses.velocity_mps, poses.sun_deg]
    if poses.angular_velocity_radps is None:
        lines.append("# no angular velocities: the kernels (CK) have none at some of these times")
    else:
        names, columns = f"{names},wx_radps,wy_radps,wz_radps", [*columns, poses.angular_velocity_radps]
    lines.append(names)
    lines += [",".join(map(repr, row)) for row in np.hstack(columns).tolist()]
    return "\n".join("".join(c if c.isprintable() else "?" for c in line) for line in lines) + "\n"


def _times(spice: Any, source: SpiceSource) -> Array:
    """Ephemeris times (N,), seconds past J2000 TDB, evenly spaced."""
    if (source.n_frames is None) == (source.step_s is None):
        raise UserError("spice", "--frames and --step-s", "both or neither", "one of them")
    begin, end = (_time(spice, name, text) for name, text in (("--start", source.start), ("--end", source.end)))
    if end < begin or (end == begin and source.n_frames != 1):
        raise UserError("--end", "", source.end, f"a time after --start, {source.start}")
    number = source.n_frames if source.step_s is None else int((end - begin) / source.step_s + 1e-9) + 1
    if number is None or not 1 <= number <= _MAX_FRAMES:
        raise UserError("spice", "frames", number, f"1 to {_MAX_FRAMES}")
    if source.step_s is not None:
        return begin + source.step_s * np.arange(number)
    return np.linspace(begin, end, number)


def _time(spice: Any, option: str, text: str) -> float:
    with reported(spice, option):
        return float(spice.str2et(text))


def _utc(spice: Any, et: float) -> str:
    with reported(spice, "time"):
        return str(spice.et2utc(et, "ISOC", 6))


def _fixed_frame(spice: Any, name: str | None) -> str:
    """The frame fixed to the Moon. Raises UserError if it is unknown or not fixed to the Moon."""
    if name is None:
        return next(each for each in _FIXED_FRAMES if spice.namfrm(each) != 0)
    _check_frame(spice, "--fixed-frame", name)
    if spice.frinfo(spice.namfrm(name))[0] != spice.bodn2c(_MOON):
        raise UserError("--fixed-frame", "", name, "a frame fixed to the Moon, such as MOON_ME or IAU_MOON")
    return name


def _check_frame(spice: Any, option: str, name: str) -> None:
    if spice.namfrm(name) == 0:
        raise UserError(option, "", name, "a frame that the kernels (FK) define")


def _body(spice: Any, name: str) -> str:
    try:
        return str(spice.bods2c(name))
    except spice.exceptions.NotFoundError:
        raise UserError("--spacecraft", "", name, "a NAIF id, or a name that the kernels define") from None


def _refuse_night(towards: Array, utc: str) -> None:
    """Raise UserError if the Sun is at or below the site's plane."""
    if towards[2] <= 0:
        degrees = np.degrees(np.arcsin(towards[2] / np.linalg.norm(towards)))
        raise UserError(
            f"SPICE: at {utc}",
            "elevation of the Sun",
            f"{degrees:.2f} degrees",
            "above 0 (the Sun is below the horizon)",
        )
