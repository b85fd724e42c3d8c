"""Direct alignment along a trajectory: each pair starts from KLT's motion and the heights of the pair before."""

import numpy as np

from perilune_train.motion.classical.alignment import Prior, State, align
from perilune_train.motion.classical.contrast import pyramid
from perilune_train.motion.classical.estimate import EstimatedMotion, ExpectedMotion, GroundPlane
from perilune_train.motion.classical.ground import N_NODES, Heights, carried, unknown_heights
from perilune_train.motion.classical.klt import NOMINAL_TURN_SIGMA_RAD, klt_motion, stretched
from perilune_train.motion.data.gyroscope import GyroscopeTurns
from perilune_train.motion.data.trajectories import Trajectory

_LEVELS = 2


def aligned_trajectory(trajectory: Trajectory, turns: GyroscopeTurns | None = None) -> EstimatedMotion:
    """Motions of a whole trajectory, from images and, where it is given, a gyroscope.

    The altitude is the true one at the first frame, then updated with the estimated motions.
    """
    nominal_translation, rotation = trajectory.nominal_motion
    turn_sigma = np.full(trajectory.n_pairs, NOMINAL_TURN_SIGMA_RAD)
    if turns is not None:
        rotation, turn_sigma = turns.rotation_c2_from_c1, turns.sigma_rad
    grey = stretched(trajectory.images)
    camera, down = trajectory.camera, trajectory.down_c
    altitude_m = float(trajectory.position_m[0, 2])
    heights = unknown_heights(camera, down, altitude_m)
    first = pyramid(trajectory.images[0], camera, _LEVELS)
    motions, covariances = [], []
    for i in range(trajectory.n_pairs):
        second = pyramid(trajectory.images[i + 1], camera, _LEVELS)
        expected, plane = (
            ExpectedMotion(nominal_translation[i], rotation[i], turn_sigma[i]),
            GroundPlane(down, altitude_m),
        )
        # KLT must know the gyroscope's rotation too: its shift balances an error of its own rotation.
        tracked = klt_motion(camera, grey[i], grey[i + 1], expected, plane)
        prior = Prior(expected, plane, heights)
        start = State(tracked.translation_m, tracked.rotation_c2_from_c1, np.zeros(2), heights.mean_m)
        found, covariance = align(first, second, prior, start)
        motion = found.translation_m, found.rotation_c2_from_c1
        down_1 = found.down_c(prior)
        lower_m = altitude_m - float(down_1 @ motion[0])
        seen = Heights(found.height_m, covariance[-N_NODES:, -N_NODES:])
        heights = carried(seen, camera, (down_1, motion[1] @ down_1), (altitude_m, lower_m), motion)
        altitude_m, first = lower_m, second
        motions.append(motion)
        covariances.append(covariance[:6, :6])
    translation, turned = (np.stack(parts) for parts in zip(*motions, strict=True))
    return EstimatedMotion((translation, turned), np.stack(covariances))
