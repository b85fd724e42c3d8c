"""The graded grid: fine where the lander ends, wider where it is only seen from high up.

The grid is rectilinear: one list of coordinates serves for x and for y, so the mesh has no hanging vertices and
stays watertight. Each place gets the spacing that the lowest altitude needs from which any descent can see it.
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.config import DatasetConfig, FlightConfig
from perilune_shared.camera import Camera
from perilune_shared.frames import Array


@dataclass(frozen=True, slots=True)
class Grid:
    """Coordinates of the vertices in O_L, the same for x and y."""

    coordinates_m: Array
    """Ascending, symmetric about 0, metres (n,)."""

    @property
    def extent_m(self) -> float:
        """Side of the square, metres."""
        return float(self.coordinates_m[-1] - self.coordinates_m[0])

    def spacing_at(self, distance_m: Array) -> Array:
        """Vertex spacing in metres at distances from the site along an axis."""
        steps = np.diff(self.coordinates_m)
        centres = (self.coordinates_m[1:] + self.coordinates_m[:-1]) / 2
        return np.interp(np.abs(distance_m), centres[centres >= 0], steps[centres >= 0])

    def half_width_for(self, spacing_m: float) -> float:
        """Half side in metres of the square in which the spacing is at most `spacing_m`; 0 where it nowhere is."""
        positive = self.coordinates_m[self.coordinates_m > 0]
        steps = np.diff(positive, prepend=-positive[0])
        fine = steps <= spacing_m * (1 + 1e-9)
        return float(positive[fine].max()) if fine.any() else 0.0


def reach_m(camera: Camera, flight: FlightConfig, altitude_m: Array) -> Array:
    """Largest horizontal distance from the site that a frame at this nominal altitude can see, metres.

    Counts the image's corner, three standard deviations of tilt and of position, and a twentieth for relief.
    """
    half_diagonal = np.hypot(
        max(camera.cx_px, camera.width_px - camera.cx_px) / camera.fx_px,
        max(camera.cy_px, camera.height_px - camera.cy_px) / camera.fy_px,
    )
    tilt = 3 * np.radians(flight.attitude_sigma_deg) * np.sqrt(2)
    share = (altitude_m - flight.end_altitude_m) / (flight.start_altitude_m - flight.end_altitude_m)
    altitude = altitude_m + 3 * flight.position_sigma_m
    view = altitude * np.tan(np.minimum(np.arctan(half_diagonal) + tilt, np.radians(80)))
    return flight.downrange_m * share**2 + 3 * np.sqrt(2) * flight.position_sigma_m + 1.05 * view


def graded_grid(config: DatasetConfig, camera: Camera, flight: FlightConfig) -> Grid:
    """The grid for a camera and a flight, with at most `terrain.max_vertices` vertices."""
    altitude = np.geomspace(flight.end_altitude_m, flight.start_altitude_m, 400)
    reach = np.maximum.accumulate(reach_m(camera, flight, altitude))
    lowest = np.maximum(altitude - 3 * flight.position_sigma_m, 0.2 * altitude)
    pixel = lowest / max(camera.fx_px, camera.fy_px)
    distance = np.linspace(0, reach[-1], 20_000)
    spacing = config.terrain.spacing_px * np.interp(distance, reach, pixel)
    steps = np.concatenate([[0], np.cumsum(np.diff(distance) / ((spacing[1:] + spacing[:-1]) / 2))])
    n_half = min(int(np.ceil(steps[-1])), (int(np.sqrt(config.terrain.max_vertices)) - 1) // 2)
    half = np.interp(np.linspace(0, steps[-1], n_half + 1), steps, distance)
    return Grid(np.concatenate([-half[:0:-1], half]))
