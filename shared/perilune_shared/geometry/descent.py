"""The nominal descent: the curve that the lander means to fly, known to the guidance before the flight.

The paper flies "a parabola" from 1500 m to 200 m without giving it. Here the lander sinks at constant speed while
its horizontal speed falls evenly to zero above the end point, so that the path is a parabola whose axis is vertical
and which ends going straight down: p(t) = p0 + v0 t + a t^2 / 2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class NominalDescent:
    """A path of constant acceleration in O_L, with the camera looking along -Z_L."""

    position_m: tuple[float, float, float]
    """Position at time 0, metres, O_L."""
    velocity_mps: tuple[float, float, float]
    """Velocity at time 0, metres per second, O_L."""
    acceleration_mps2: tuple[float, float, float]
    """Acceleration, metres per second squared, O_L."""
    duration_s: float
    """Time from first to last frame, seconds."""

    @classmethod
    def parabola(
        cls,
        start_altitude_m: float,
        end_altitude_m: float,
        downrange_m: float,
        azimuth_deg: float,
        duration_s: float,
    ) -> "NominalDescent":
        """Starts `downrange_m` from the site in the direction `azimuth_deg` (clockwise from north), ends above it."""
        azimuth = np.radians(azimuth_deg)
        x, y = -np.sin(azimuth) * downrange_m, -np.cos(azimuth) * downrange_m
        sink = (end_altitude_m - start_altitude_m) / duration_s
        return cls(
            (float(x), float(y), float(start_altitude_m)),
            (float(-2 * x / duration_s), float(-2 * y / duration_s), float(sink)),
            (float(2 * x / duration_s**2), float(2 * y / duration_s**2), 0.0),
            float(duration_s),
        )

    def position_at(self, time_s: ArrayLike) -> Array:
        """Positions (..., 3) in metres, O_L, at times (...)."""
        t = np.asarray(time_s, np.float64)[..., None]
        return np.array(self.position_m) + np.array(self.velocity_mps) * t + np.array(self.acceleration_mps2) * t**2 / 2

    def velocity_at(self, time_s: ArrayLike) -> Array:
        """Velocities (..., 3) in metres per second, O_L, at times (...)."""
        return (
            np.array(self.velocity_mps) + np.array(self.acceleration_mps2) * np.asarray(time_s, np.float64)[..., None]
        )


ROTATION_CAMERA_FROM_BODY = np.diag([1.0, -1.0, -1.0])
"""The camera looks along -Z_B with its x axis along X_B: the default mounting, and with a body that is level in O_L
the paper's "along the negative axis of Z_L"."""
