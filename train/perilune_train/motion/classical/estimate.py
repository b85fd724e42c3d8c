"""What a method of relative motion returns for a trajectory."""

from dataclasses import dataclass

from perilune_shared.geometry.frames import Array
from perilune_train.motion.data.trajectories import Motion


@dataclass(frozen=True, slots=True)
class EstimatedMotion:
    """Estimated motions of a trajectory of n frames."""

    motion: Motion
    """translation_m (n - 1, 3) and rotation_c2_from_c1 (n - 1, 3, 3)."""
    covariance: Array
    """Of each rotation (turn from the left, radians) and shift (metres, O_C of the later frame): (n - 1, 6, 6)."""
