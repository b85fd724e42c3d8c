"""Simulated instruments: an inertial unit, and a laser altimeter that looks along the camera's axis.

An inertial measurement holds the angular rate and the specific force (acceleration without gravity) in the body's axes,
averaged over an interval: the increments of a strapdown unit divided by the interval. Each axis adds a bias and white
noise to the true value. The bias is drawn once for each trajectory and then follows a random walk. Scale factors,
misalignment and quantisation are not simulated.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perilune_render.config.dataset import InstrumentsConfig
from perilune_render.flight.motion import Motion
from perilune_render.flight.trajectories import Flight
from perilune_render.streams import stream
from perilune_render.terrain.interpolation import value_at
from perilune_render.terrain.scene import Scene
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_errors import drawn_errors
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade

_MAX_STEPS = 50
"""Largest number of iterations to find a range."""
_TOLERANCE_M = 1e-3
"""Change in one iteration below which a range has converged, metres."""


@dataclass(frozen=True, slots=True)
class Increments:
    """Mean angular rates and specific forces over consecutive intervals of a trajectory, from time 0."""

    time_s: Array
    """End of each interval, seconds since the first frame (N,)."""
    interval_s: Array
    """Length of each interval, seconds (N,)."""
    angular_rate_radps: Array
    """Mean angular rates, O_B, radians per second (N, 3)."""
    specific_force_mps2: Array
    """Mean specific forces, O_B, metres per second squared (N, 3)."""


def true_increments(motion: Motion, rate_hz: float) -> Increments:
    """Increments without errors, `rate_hz` per second; the last interval may be shorter.

    Rotating the attitude at the start of an interval by the angular rate times the interval gives exactly the attitude
    at its end. The specific force is integrated by Simpson's rule.
    """
    duration_s = motion.nominal.duration_s
    time = np.arange(int(np.ceil(duration_s * rate_hz - 1e-9)) + 1) / rate_hz
    time[-1] = duration_s
    interval = np.diff(time)
    with_middles = np.empty(2 * len(time) - 1)
    with_middles[::2], with_middles[1::2] = time, time[:-1] + interval / 2
    rotation = motion.rotation_site_from_body_at(with_middles)
    position, _, acceleration = motion.path_at(with_middles)
    force = np.einsum("nji,nj->ni", rotation, acceleration - gravity_mps2(position[:, 2]))
    turn = np.einsum("nji,njk->nik", rotation[:-2:2], rotation[2::2])
    mean_force = (force[:-2:2] + 4 * force[1::2] + force[2::2]) / 6
    return Increments(time[1:], interval, rotation_vectors(turn) / interval[:, None], mean_force)


def measured(true: Increments, grade: InertialGrade, seed: int) -> Increments:
    """The increments that an inertial unit of a grade measures; `seed` is the trajectory's random seed."""
    gyro, accelerometer = drawn_errors(GRADES[grade], true.interval_s, stream(seed, "inertial", grade))
    rate, force = true.angular_rate_radps + gyro, true.specific_force_mps2 + accelerometer
    return Increments(true.time_s, true.interval_s, rate, force)


@dataclass(frozen=True, slots=True)
class Ranges:
    """Measurements of the altimeter along a trajectory."""

    time_s: Array
    """Times since the first frame, seconds (N,)."""
    range_m: Array
    """Measured distances to the ground along -Z_B, metres (N,); NaN without a return."""


def measure_ranges(motion: Motion, scene: Scene, config: InstrumentsConfig, duration_s: float, seed: int) -> Ranges:
    """Simulate the altimeter's ranges along a trajectory; `seed` is its random seed.

    The beam passes through boulders.
    """
    time = np.arange(int(np.floor(duration_s * config.range_rate_hz + 1e-9)) + 1) / config.range_rate_hz
    beam = -motion.rotation_site_from_body_at(time)[:, :, 2]
    true_m = range_to_ground_m(scene, motion.path_at(time)[0], beam)
    sigma_m = config.range_sigma_m + config.range_sigma_share * true_m
    return Ranges(time, true_m + sigma_m * stream(seed, "ranges").normal(size=len(time)))


def measure_ranges_of_frames(
    flight: Flight, frame_index: Sequence[int], scene: Scene, config: InstrumentsConfig, seed: int
) -> Ranges:
    """Simulate one range at each frame of a flight; `seed` is the random seed of its trajectory.

    The beam is along the axis of the camera.
    """
    true_m = range_to_ground_m(scene, flight.position_m, flight.rotation_camera_from_site[:, 2])
    sigma_m = config.range_sigma_m + config.range_sigma_share * true_m
    # Each frame has a separate random stream, so that parts of one trajectory in several scenes have different noise.
    noise = np.array([stream(seed, "range", index).normal() for index in frame_index])
    return Ranges(flight.time_s, true_m + sigma_m * noise)


def range_to_ground_m(scene: Scene, position_m: Array, direction: Array) -> Array:
    """Distances (N,) from positions (N, 3) along unit vectors (N, 3), O_L, to the ground, metres.

    Each iteration computes the distance from the height of the ground below the last point of the ray. The iteration
    converges where the ground is less steep than the ray. The distance is NaN elsewhere, beyond the terrain, and for
    rays that do not point downwards.
    """
    x, y, z = position_m.T
    dx, dy, dz = direction.T
    distance, change = z / -dz, np.full(len(z), np.inf)
    for _ in range(_MAX_STEPS):
        ground = value_at(scene.height_m, scene.grid, x + distance * dx, y + distance * dy)
        following = (z - ground) / -dz
        change = np.abs(following - distance)
        distance = following
        if (change < _TOLERANCE_M).all():
            break
    half = scene.grid.extent_m / 2
    within = (np.abs(x + distance * dx) <= half) & (np.abs(y + distance * dy) <= half)
    return np.where((change < _TOLERANCE_M) & within & (distance > 0) & (dz < 0), distance, np.nan)
