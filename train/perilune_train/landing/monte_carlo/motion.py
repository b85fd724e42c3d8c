"""True motion of a lander between the frames of a descent, to simulate further sensors."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.gravity import gravity_mps2
from perilune_train.landing.filter.propagate import Increments
from perilune_train.landing.filter.state import rotation_matrices
from perilune_train.landing.methods.seen import SeenDescent


@dataclass(frozen=True, slots=True)
class TrueMotion:
    """Velocity and attitude at the ends of N inertial measurements."""

    time_s: Array
    """Times (N,), seconds since the first frame."""
    velocity_mps: Array
    """Velocities (N, 3), metres per second, O_L."""
    rotation_site_from_body: Array
    """Attitudes (N, 3, 3)."""

    def at_rate(self, rate_hz: float) -> "TrueMotion":
        """The motion at the multiples of 1 / `rate_hz`, or at the first later time."""
        wanted = np.arange(1, int(self.time_s[-1] * rate_hz + 1e-6) + 1) / rate_hz
        index = np.unique(np.searchsorted(self.time_s, wanted - 1e-6))
        return TrueMotion(self.time_s[index], self.velocity_mps[index], self.rotation_site_from_body[index])


def true_motion(
    descent: SeenDescent, frame_velocity_mps: Array, reference: Increments, rotation_camera_from_body: Array
) -> TrueMotion:
    """Integrate nearly exact inertial measurements from each frame to the next.

    Each integration starts at the true pose and velocity of a frame; `frame_velocity_mps` (n, 3), O_L. With
    measurements of the grade `navigation` and 1.7 s between frames, attitudes are correct to 0.3 seconds of arc and
    velocities to 2 mm/s.
    """
    time_s, velocities, attitudes = reference.time_s, [], []
    frame_of = np.clip(np.searchsorted(descent.time_s, time_s - 1e-9, side="right") - 1, 0, None)
    before_s = np.maximum(np.concatenate([[0.0], time_s[:-1]]), descent.time_s[frame_of])
    step_s = time_s - before_s
    half = rotation_matrices(reference.angular_rate_radps * (step_s / 2)[:, None])
    current, height_m, velocity, rotation = -1, 0.0, np.zeros(3), np.eye(3)
    for k in range(len(time_s)):
        if frame_of[k] != current:
            current = frame_of[k]
            pose = descent.true[current]
            height_m, velocity = float(pose.position_m[2]), frame_velocity_mps[current]
            rotation = pose.rotation_camera_from_site.T @ rotation_camera_from_body
        middle = rotation @ half[k]
        height_m += float(velocity[2]) * step_s[k]
        velocity = velocity + (middle @ reference.specific_force_mps2[k] + gravity_mps2(height_m)) * step_s[k]
        rotation = middle @ half[k]
        velocities.append(velocity)
        attitudes.append(rotation)
    return TrueMotion(time_s, np.array(velocities), np.array(attitudes))
