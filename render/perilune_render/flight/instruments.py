"""Simulated instruments: an inertial unit, a laser altimeter, a star tracker and a Doppler lidar.

The altimeter looks along the camera's axis.

An inertial measurement holds the angular rate and the specific force (acceleration without gravity) in the body's axes,
averaged over an interval: the increments of a strapdown unit divided by the interval. Each axis adds a bias and white
noise to the true value. The bias is drawn once for each trajectory and then follows a random walk. Some grades also
have scale factors and misaligned axes. Quantisation is not simulated.

A star tracker measures the attitude with white noise, and nothing during an outage. The rotation of the Moon is not
simulated: stars and site keep their directions. A Doppler lidar measures the distance to the ground and the speed over
ground along each of its slanted beams (for example NASA's Navigation Doppler Lidar, which has three).
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
from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_errors import drawn_axes, drawn_errors
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
    rate, force = true.angular_rate_radps, true.specific_force_mps2
    if GRADES[grade].scale_ppm or GRADES[grade].misalignment_arcsec:
        of_gyro, of_accelerometer = drawn_axes(GRADES[grade], stream(seed, "inertial axes", grade))
        rate, force = rate @ of_gyro.T, force @ of_accelerometer.T
    return Increments(true.time_s, true.interval_s, rate + gyro, force + accelerometer)


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
    time = _times(duration_s, config.range_rate_hz)
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


@dataclass(frozen=True, slots=True)
class Attitudes:
    """Measurements of the star tracker along a trajectory."""

    time_s: Array
    """Times since the first frame, seconds (N,), without those of outages."""
    rotation_body_from_site: Array
    """Measured attitudes (N, 3, 3)."""


def measure_attitudes(motion: Motion, config: InstrumentsConfig, seed: int) -> Attitudes:
    """Simulate the star tracker along a trajectory; `seed` is the trajectory's random seed."""
    time = _times(motion.nominal.duration_s, config.star_tracker_rate_hz)
    sigmas_rad = np.radians(np.array(config.star_tracker_sigma_arcsec) / 3600)
    # Draw the noise of all times, so that an outage does not change the other measurements.
    turns = sigmas_rad * stream(seed, "star tracker").normal(size=(len(time), 3))
    seen = np.ones(len(time), bool)
    for outage in config.star_tracker_outages_s:
        seen &= (time < outage.low) | (time >= outage.high)
    rotation = motion.rotation_site_from_body_at(time[seen])
    measured = rotation @ np.array([matrix_from_rotation_vector(turn) for turn in turns[seen]]).reshape(-1, 3, 3)
    return Attitudes(time[seen], np.swapaxes(measured, 1, 2))


@dataclass(frozen=True, slots=True)
class Beams:
    """Measurements of the Doppler lidar along a trajectory, for each of its B beams."""

    time_s: Array
    """Times since the first frame, seconds (N,)."""
    direction_in_body: Array
    """Directions of the beams (B, 3), unit vectors, O_B."""
    speed_mps: Array
    """Measured speeds over ground along the beams (B, N), positive towards the ground; NaN without a return."""
    range_m: Array
    """Measured distances to the ground along the beams (B, N); NaN without a return."""


def measure_beams(motion: Motion, scene: Scene, config: InstrumentsConfig, seed: int) -> Beams:
    """Simulate the Doppler lidar along a trajectory; `seed` is the trajectory's random seed.

    The beams lie on a cone around -Z_B, the first one in the plane of X_B and Z_B. They ignore boulders.
    """
    azimuth = 2 * np.pi * np.arange(config.doppler_beams) / config.doppler_beams
    angle = np.radians(config.doppler_beam_angle_deg)
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    directions = np.column_stack([np.sin(angle) * around, np.full(len(azimuth), -np.cos(angle))])
    time = _times(motion.nominal.duration_s, config.doppler_rate_hz)
    position, velocity, _ = motion.path_at(time)
    rotation = motion.rotation_site_from_body_at(time)
    speeds, ranges = [], []
    for number, direction in enumerate(directions):
        along = rotation @ direction
        noise = stream(seed, "doppler lidar", number).normal(size=(2, len(time)))
        true_m = range_to_ground_m(scene, position, along)
        ranges.append(true_m + config.doppler_range_sigma_m * noise[0])
        speed = (velocity * along).sum(axis=1) + config.doppler_speed_sigma_mps * noise[1]
        speeds.append(np.where(np.isfinite(true_m), speed, np.nan))
    return Beams(time, directions, np.array(speeds), np.array(ranges))


def _times(duration_s: float, rate_hz: float) -> Array:
    """Times from 0 to the end of a trajectory, `rate_hz` per second."""
    return np.arange(int(np.floor(duration_s * rate_hz + 1e-9)) + 1) / rate_hz


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
