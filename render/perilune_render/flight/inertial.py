"""Simulated inertial measurements: gyroscopes and accelerometers along a motion.

A measurement is the mean over its interval of the angular rate and of the specific force (acceleration without
gravity), in the body's axes: what a strapdown unit gives as increments, divided by the interval. To the true value each
axis adds a bias and white noise. The bias is drawn once for each trajectory and then walks. Scale factors, misalignment
and quantisation are not simulated.
"""

from dataclasses import dataclass

import numpy as np

from perilune_render.flight.motion import Motion
from perilune_render.streams import stream
from perilune_shared.geometry.frames import Array, rotation_vectors
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_shared.geometry.inertial_errors import drawn_errors
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade


@dataclass(frozen=True, slots=True)
class Increments:
    """Mean angular rates and specific forces over consecutive intervals, from time 0 to the end of a trajectory."""

    time_s: Array
    """End of each interval, seconds since the first frame (N,)."""
    interval_s: Array
    """Length of each interval, seconds (N,)."""
    angular_rate_radps: Array
    """Mean angular rates, O_B, radians per second (N, 3)."""
    specific_force_mps2: Array
    """Mean specific forces, O_B, metres per second squared (N, 3)."""


def true_increments(motion: Motion, rate_hz: float) -> Increments:
    """Increments without errors, `rate_hz` of them per second; the last interval may be shorter.

    Turned by the angular rate for the interval, the attitude at its start is exactly that at its end. The specific
    force is integrated by Simpson's rule.
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
    """The increments as a unit of this grade measures them on the trajectory of a random seed."""
    gyro, accelerometer = drawn_errors(GRADES[grade], true.interval_s, stream(seed, "inertial", grade))
    rate, force = true.angular_rate_radps + gyro, true.specific_force_mps2 + accelerometer
    return Increments(true.time_s, true.interval_s, rate, force)
