"""The view envelope of a flight or of a given scene: how far its frames reach from each altitude."""

import numpy as np

from perilune_render.config.dataset import DatasetConfig, FlightConfig
from perilune_render.config.scene import HIGHEST_M, SceneConfig
from perilune_render.flight.rig import Rig
from perilune_render.terrain.envelope import SeenGround, ViewEnvelope
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.curvature import horizon_m
from perilune_shared.geometry.frames import Array

_N_ALTITUDES = 400
_N_HEIGHTS = 100
_WIDEST_RAD = np.radians(80)
"""Largest angle from straight down at which frames may show ground, radians."""
_N_DISTANCES, _N_PLACES = 200, 1000
_HILL_M = 64.0
"""Height of the largest hills that the relief and the craters of default settings make, metres."""


def view_of(config: DatasetConfig, rig: Rig, kind: str) -> ViewEnvelope:
    """The views of all cameras on the body, for which the ground of a configuration is generated.

    Raises UserError if frames of the flights of `kind` could show the horizon, or if a given scene has no views.
    """
    if config.scene is not None:
        return scene_view(config.scene, *(each.exr_camera for each in rig.values()))
    return rig_envelope(rig, config.ground_flight(kind))


def scene_view(scene: SceneConfig, *cameras: Camera) -> ViewEnvelope:
    """The views of a given scene, for the cameras of the renderings. Raises UserError if the scene has no views."""
    if not scene.views:
        raise UserError("configuration", "dataset.scene.views", "none", "at least one height_m with its reach_m")
    height, reach = (np.array([getattr(view, name) for view in scene.views]) for name in ("height_m", "reach_m"))
    focal_px = max(_focal_px(camera) for camera in cameras)
    if scene.horizon:
        return ViewEnvelope(*_up_to_horizon(height, reach), focal_px, horizon=True)
    return ViewEnvelope(height, reach, focal_px)


def _up_to_horizon(height_m: Array, reach_m: Array) -> tuple[Array, Array]:
    """Smallest distance of a camera from the ground, by the ground's distance from the site.

    Returns both distances, (M,) each, metres. Cameras at the distance `reach_m[i]` from the site are at `height_m[i]`
    or above, with linear interpolation. The ground extends beyond the horizon of the highest camera to where a hill of
    height _HILL_M is hidden.
    """
    edge = reach_m[-1] + float(horizon_m(height_m[-1]) + horizon_m(_HILL_M))
    distance = np.union1d(np.geomspace(min(height_m[0], reach_m[0]), edge, _N_DISTANCES), reach_m)
    camera = np.linspace(0, reach_m[-1], _N_PLACES)
    away = np.hypot(np.interp(camera, reach_m, height_m), np.maximum(distance[:, None] - camera, 0))
    return np.maximum.accumulate(away.min(axis=1)), distance


def horizon_envelope(camera: Camera, flight: FlightConfig) -> ViewEnvelope:
    """The views up to the horizon from all trajectories of a flight.

    Trajectories are up to three standard deviations from the nominal trajectory. Raises UserError if the trajectories
    can begin above HIGHEST_M.
    """
    altitude, spread = np.geomspace(flight.end_altitude_m, flight.start_altitude_m, _N_ALTITUDES), _spread_m(flight)
    highest = flight.start_altitude_m + spread
    if highest > HIGHEST_M:
        expected = f"height_m of at most {HIGHEST_M:g}; the preset's descents begin too high for a horizon"
        raise UserError("configuration", "dataset.scene.views", "none", expected)
    reach = np.maximum.accumulate(nominal_distance_m(flight, altitude) + max(spread, 0.1 * flight.end_altitude_m))
    height = np.append(_lowest_m(flight, altitude), highest)
    return ViewEnvelope(*_up_to_horizon(height, np.append(reach, reach[-1])), _focal_px(camera), horizon=True)


def _focal_px(camera: Camera) -> float:
    """Largest number of pixels per radian near the axis of a pinhole, or in the image of a lens model."""
    return max(camera.fx_px, camera.fy_px) if camera.lens is None else camera.scale_px


def rig_envelope(rig: Rig, flight: FlightConfig) -> ViewEnvelope:
    """The views of all cameras on a body: at each distance, the finest spacing that any camera needs.

    Raises UserError as `view_envelope` does.
    """
    if flight.is_oblique:
        lens = max((each.exr_camera for each in rig.values()), key=_focal_px)
        flights = [each.flight_settings(flight) for each in rig.values()]
        return horizon_envelope(lens, max(flights, key=lambda each: each.position_sigma_m))
    views = [view_envelope(each.levelled(), each.flight_settings(flight)) for each in rig.values()]
    return views[0] if len(views) == 1 else _joined(views)


def _joined(views: list[ViewEnvelope]) -> ViewEnvelope:
    """The envelope of several views, with their largest focal length, to which heights are scaled."""
    focal = max(view.focal_px for view in views)
    reach = np.unique(np.concatenate([view.reach_m for view in views]))
    heights = []
    for view in views:
        distance, first = np.unique(view.reach_m, return_index=True)
        height = np.interp(reach, distance, view.height_m[first]) * focal / view.focal_px
        heights.append(np.where(reach <= distance[-1], height, np.inf))
    seen = [view.seen for view in views if view.seen is not None]
    # Levels are selected by camera height alone, so all levels have the spacing for the largest focal length.
    z = np.geomspace(min(each.z_m[0] for each in seen), max(each.z_m[-1] for each in seen), _N_HEIGHTS)
    nearest = np.min([np.interp(z, each.z_m, each.nearest_m) for each in seen], axis=0)
    farthest = np.max([np.interp(z, each.z_m, each.farthest_m) for each in seen], axis=0)
    margin = np.max([np.interp(z, each.z_m, each.margin_m) for each in seen], axis=0)
    return ViewEnvelope(np.min(heights, axis=0), reach, focal, SeenGround(z, 0.95 * z, nearest, farthest, margin))


def view_envelope(camera: Camera, flight: FlightConfig) -> ViewEnvelope:
    """The views of a camera on all trajectories of a flight.

    Trajectories are up to three standard deviations from the nominal trajectory. Views of an oblique flight extend to
    the horizon. Raises UserError if frames of another flight could show the horizon.
    """
    if flight.is_oblique:
        return horizon_envelope(camera, flight)
    angle = view_angle(camera, flight)
    if angle > _WIDEST_RAD:
        wide = f"frames reach {np.degrees(angle):.0f} degrees from straight down"
        raise UserError("configuration", "dataset.camera", wide, f"at most {np.degrees(_WIDEST_RAD):.0f}")
    altitude = np.geomspace(flight.end_altitude_m, flight.start_altitude_m, _N_ALTITUDES)
    reach = np.maximum.accumulate(reach_m(camera, flight, altitude))
    return ViewEnvelope(
        _lowest_m(flight, altitude), reach, max(camera.fx_px, camera.fy_px), seen_ground(camera, flight)
    )


def _spread_m(flight: FlightConfig) -> float:
    """Three standard deviations of the position, metres."""
    return 3 * flight.position_sigma_m


def _lowest_m(flight: FlightConfig, altitude_m: Array) -> Array:
    """Lowest height above the ground at nominal altitudes (N,).

    The ground may rise by a twentieth of the altitude. The result is at least a fifth of the altitude.
    """
    return np.maximum(0.95 * altitude_m - _spread_m(flight), 0.2 * altitude_m)


def view_angle(camera: Camera, flight: FlightConfig) -> float:
    """Largest angle from straight down, along either image axis, at which a frame shows ground, radians."""
    half_view = max(
        max(camera.cx_px, camera.width_px - camera.cx_px) / camera.fx_px,
        max(camera.cy_px, camera.height_px - camera.cy_px) / camera.fy_px,
    )
    return float(np.arctan(half_view) + 3 * np.radians(flight.attitude_sigma_deg))


def reach_m(camera: Camera, flight: FlightConfig, altitude_m: Array) -> Array:
    """Largest |x| or |y| from the site that a frame at this nominal altitude can show, metres.

    Includes three standard deviations of tilt, rotation and position, and a margin of a twentieth for relief.
    """
    view = half_view_m(camera, flight, altitude_m + 3 * flight.position_sigma_m)
    return nominal_distance_m(flight, altitude_m) + 3 * flight.position_sigma_m + 1.05 * view


def nominal_distance_m(flight: FlightConfig, altitude_m: Array) -> Array:
    """Horizontal distance from the site at a nominal altitude, metres."""
    share = (altitude_m - flight.end_altitude_m) / (flight.start_altitude_m - flight.end_altitude_m)
    return flight.downrange_m * share**2


def half_view_m(camera: Camera, flight: FlightConfig, altitude_m: Array) -> Array:
    """Largest |dx| or |dy| from the point below the camera to level ground in view, metres.

    The camera's axes are parallel to the axes of O_L except for small rotations, so a frame covers a square along the
    axes. Includes three standard deviations of tilt and rotation.
    """
    turn = min(3 * np.radians(flight.attitude_sigma_deg), np.pi / 4)
    slope = np.tan(view_angle(camera, flight)) * (np.cos(turn) + np.sin(turn))
    return altitude_m * slope


def seen_ground(camera: Camera, flight: FlightConfig) -> SeenGround:
    """The ground in view at each camera height, with the margins of `view_envelope`.

    Errors of position and attitude are independent, so their three standard deviations are added in quadrature.
    """
    spread = 3 * flight.position_sigma_m
    lowest, highest = flight.end_altitude_m, flight.start_altitude_m
    z = np.geomspace(max(lowest - spread, 0.2 * lowest), highest + spread, _N_HEIGHTS)
    nearest, farthest = (nominal_distance_m(flight, np.clip(z + sign * spread, lowest, highest)) for sign in (-1, 1))
    level = half_view_m(camera, flight.model_copy(update={"attitude_sigma_deg": 0.0}), z)
    margin = 1.05 * level + np.hypot(spread, 1.05 * (half_view_m(camera, flight, z) - level))
    return SeenGround(z, 0.95 * z, nearest, farthest, margin)
