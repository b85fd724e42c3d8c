"""What the classical methods know in advance about a pair of frames, and their result for a trajectory."""

from dataclasses import dataclass

from perilune_shared.geometry.frames import Array
from perilune_train.motion.data.trajectories import Motion


@dataclass(frozen=True, slots=True)
class ExpectedMotion:
    """Prior knowledge of the motion between two frames."""

    translation_m: Array
    """Motion (3,), metres, O_C of frame 1."""
    rotation_c2_from_c1: Array
    """Rotation (3, 3)."""
    turn_sigma_rad: float
    """Standard deviation of the true rotation from the expected one, about each axis, radians."""


@dataclass(frozen=True, slots=True)
class GroundPlane:
    """The plane below a camera."""

    down_c: Array
    """Unit vector (3,) towards the ground, O_C."""
    altitude_m: float
    """Distance of the camera from the plane, metres."""


@dataclass(frozen=True, slots=True)
class EstimatedMotion:
    """Estimated motions of a trajectory of n frames."""

    motion: Motion
    """translation_m (n - 1, 3) and rotation_c2_from_c1 (n - 1, 3, 3)."""
    covariance: Array
    """Covariances (n - 1, 6, 6) of rotation and shift. The rotation is a turn that multiplies from the left, in
    radians; the shift is in metres, O_C of the later frame."""
