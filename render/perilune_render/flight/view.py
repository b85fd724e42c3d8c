"""The view envelope of a flight: how far its frames reach from each altitude."""

import numpy as np

from perilune_render.config import FlightConfig
from perilune_render.terrain.envelope import ViewEnvelope
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array

_N_ALTITUDES = 400
_WIDEST_RAD = np.radians(80)


def view_envelope(camera: Camera, flight: FlightConfig) -> ViewEnvelope:
    """The views of a camera on all trajectories of a flight, up to three standard deviations from the nominal one.

    Raises UserError if frames could show the horizon.
    """
    angle = view_angle(camera, flight)
    if angle > _WIDEST_RAD:
        wide = f"frames reach {np.degrees(angle):.0f} degrees from straight down"
        raise UserError("configuration", "dataset.camera", wide, f"at most {np.degrees(_WIDEST_RAD):.0f}")
    altitude = np.geomspace(flight.end_altitude_m, flight.start_altitude_m, _N_ALTITUDES)
    # The ground may rise towards the camera by a twentieth of the altitude.
    lowest = np.maximum(0.95 * altitude - 3 * flight.position_sigma_m, 0.2 * altitude)
    reach = np.maximum.accumulate(reach_m(camera, flight, altitude))
    return ViewEnvelope(lowest, reach, max(camera.fx_px, camera.fy_px))


def view_angle(camera: Camera, flight: FlightConfig) -> float:
    """Largest angle from straight down, along either image axis, at which a frame shows the ground, radians."""
    half_view = max(
        max(camera.cx_px, camera.width_px - camera.cx_px) / camera.fx_px,
        max(camera.cy_px, camera.height_px - camera.cy_px) / camera.fy_px,
    )
    return float(np.arctan(half_view) + 3 * np.radians(flight.attitude_sigma_deg))


def reach_m(camera: Camera, flight: FlightConfig, altitude_m: Array) -> Array:
    """Largest |x| or |y| from the site that a frame at this nominal altitude can show, metres.

    The camera's axes are parallel to those of O_L except for small rotations, so a frame covers a square along the
    axes. Includes three standard deviations of tilt, rotation and position, and a margin of a twentieth for relief.
    """
    turn = min(3 * np.radians(flight.attitude_sigma_deg), np.pi / 4)
    share = (altitude_m - flight.end_altitude_m) / (flight.start_altitude_m - flight.end_altitude_m)
    slope = np.tan(view_angle(camera, flight)) * (np.cos(turn) + np.sin(turn))
    view = (altitude_m + 3 * flight.position_sigma_m) * slope
    return flight.downrange_m * share**2 + 3 * flight.position_sigma_m + 1.05 * view
