"""Simulated ranges of a laser altimeter that looks along the camera's axis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perilune_render.config.dataset import InstrumentsConfig
from perilune_render.flight.motion import Motion
from perilune_render.flight.trajectories import Flight
from perilune_render.streams import stream
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array

_MOST_STEPS = 50
_TOLERANCE_M = 1e-3


@dataclass(frozen=True, slots=True)
class Ranges:
    """Measurements of the altimeter along a trajectory."""

    time_s: Array
    """Times since the first frame, seconds (N,)."""
    range_m: Array
    """Measured distances to the ground along -Z_B, metres (N,); NaN without a return."""


def measure_ranges(motion: Motion, scene: Scene, config: InstrumentsConfig, duration_s: float, seed: int) -> Ranges:
    """Simulate the ranges of a trajectory with this random seed. Boulders are not in the way of the beam."""
    time = np.arange(int(np.floor(duration_s * config.range_rate_hz + 1e-9)) + 1) / config.range_rate_hz
    beam = -motion.rotation_site_from_body_at(time)[:, :, 2]
    true_m = range_to_ground_m(scene, motion.path_at(time)[0], beam)
    sigma_m = config.range_sigma_m + config.range_sigma_share * true_m
    return Ranges(time, true_m + sigma_m * stream(seed, "ranges").normal(size=len(time)))


def measure_ranges_of_frames(
    flight: Flight, frame_index: Sequence[int], scene: Scene, config: InstrumentsConfig, seed: int
) -> Ranges:
    """Simulate one range at each frame of a flight, given its random seed; the beam is the axis of the camera."""
    true_m = range_to_ground_m(scene, flight.position_m, flight.rotation_camera_from_site[:, 2])
    sigma_m = config.range_sigma_m + config.range_sigma_share * true_m
    # Of each frame's own stream: parts of one trajectory in several scenes have different noise.
    noise = np.array([stream(seed, "range", index).normal() for index in frame_index])
    return Ranges(flight.time_s, true_m + sigma_m * noise)


def range_to_ground_m(scene: Scene, position_m: Array, direction: Array) -> Array:
    """Distances (N,) from positions (N, 3) along unit vectors (N, 3), O_L, to the ground, metres.

    Iterates: the height of the ground where the ray was last gives the next distance. It converges where the ground is
    less steep than the ray; elsewhere, and beyond the terrain, the distance is NaN.
    """
    x, y, z = position_m.T
    dx, dy, dz = direction.T
    distance, change = z / -dz, np.full(len(z), np.inf)
    for _ in range(_MOST_STEPS):
        ground = value_at(scene.height_m, scene.grid, x + distance * dx, y + distance * dy)
        following = (z - ground) / -dz
        change = np.abs(following - distance)
        distance = following
        if (change < _TOLERANCE_M).all():
            break
    half = scene.grid.extent_m / 2
    within = (np.abs(x + distance * dx) <= half) & (np.abs(y + distance * dy) <= half)
    return np.where((change < _TOLERANCE_M) & within & (distance > 0) & (dz < 0), distance, np.nan)
