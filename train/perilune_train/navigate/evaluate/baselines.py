"""The baselines that use no image: mean motions of the training set."""

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_train.navigate.data.trajectories import Motion, Trajectory


def mean_motion(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The training set's mean motion, for every pair of the trajectory."""
    translation = np.concatenate([d.motion[0] for d in training]).mean(0)
    rotation = _mean_rotation(np.concatenate([d.motion[1] for d in training]))
    return np.tile(translation, (trajectory.n_pairs, 1)), np.tile(rotation, (trajectory.n_pairs, 1, 1))


def mean_motion_at_step(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The training set's mean motion at each step; beyond its longest trajectory, that of its last step."""
    translations, rotations = [], []
    longest = max(d.n_pairs for d in training)
    for step in range(trajectory.n_pairs):
        motions = [
            (d.motion[0][min(step, longest - 1)], d.motion[1][min(step, longest - 1)])
            for d in training
            if d.n_pairs > min(step, longest - 1)
        ]
        translations.append(np.mean([t for t, _ in motions], axis=0))
        rotations.append(_mean_rotation(np.stack([r for _, r in motions])))
    return np.stack(translations), np.stack(rotations)


def _mean_rotation(rotations: Array) -> Array:
    """The rotation nearest to the mean of the matrices (Moakher 2002, doi 10.1137/S0895479801383877)."""
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
