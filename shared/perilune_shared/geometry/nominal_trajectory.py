"""The nominal trajectory: the planned path, which the guidance knows before the flight.

The paper by Song et al. uses "a parabola" from 1500 m to 200 m without details. Here the vertical speed is constant,
and the horizontal speed decreases linearly to zero at the end point: p(t) = p0 + v0 t + a t^2 / 2 with a horizontal a.
The path is a parabola with a horizontal axis; it is vertical at its end.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perilune_shared.geometry.frames import Array


@dataclass(frozen=True, slots=True)
class NominalTrajectory:
    """A trajectory of constant acceleration in O_L, with the camera looking along -Z_L."""

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
    ) -> "NominalTrajectory":
        """Create a trajectory that ends above the site.

        The start is `downrange_m` from the site, in the direction `azimuth_deg` (from the site, clockwise from north).
        """
        azimuth = np.radians(azimuth_deg)
        x, y = -np.sin(azimuth) * downrange_m, -np.cos(azimuth) * downrange_m
        sink = (end_altitude_m - start_altitude_m) / duration_s
        return cls(
            (float(x), float(y), float(start_altitude_m)),
            (float(-2 * x / duration_s), float(-2 * y / duration_s), float(sink)),
            (float(2 * x / duration_s**2), float(2 * y / duration_s**2), 0.0),
            float(duration_s),
        )

    @property
    def approach_deg(self) -> int:
        """Direction from the site to the start, whole degrees clockwise from north."""
        return approach_deg(self.position_m)

    def position_at(self, time_s: ArrayLike) -> Array:
        """Return positions (..., 3) in O_L, metres, at times (...)."""
        t = np.asarray(time_s, np.float64)[..., None]
        return np.array(self.position_m) + np.array(self.velocity_mps) * t + np.array(self.acceleration_mps2) * t**2 / 2

    def velocity_at(self, time_s: ArrayLike) -> Array:
        """Return velocities (..., 3) in O_L, metres per second, at times (...)."""
        return (
            np.array(self.velocity_mps) + np.array(self.acceleration_mps2) * np.asarray(time_s, np.float64)[..., None]
        )


def approach_deg(start_m: Sequence[float]) -> int:
    """Return the direction from the site to the start (3,), O_L, whole degrees clockwise from north.

    Returns 0 if the start is directly above the site.
    """
    return round(float(np.degrees(np.arctan2(-start_m[0], -start_m[1])))) % 360 if any(start_m[:2]) else 0
