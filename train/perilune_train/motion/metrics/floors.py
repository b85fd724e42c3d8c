"""Baselines that a pose network must beat: mean poses of the training set, and ridge regression on frozen features."""

from dataclasses import dataclass

import numpy as np

from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.data.trajectories import Pose, Trajectory
from perilune_train.motion.geometry import mean_rotation

FLOORS = {
    "mean_pose": "mean pose of the training, without images",
    "mean_pose_at_frame": "mean pose of the training at that frame, without images",
    "ridge": "ridge regression on the frozen features",
}
"""Names, in tables, of the methods that a pose network is compared with."""
_PENALTIES = np.logspace(-6, 2, 17)
"""Penalties of the ridge regression, in units of the mean squared length of a standardised feature vector."""


def mean_poses(training: list[Trajectory], test: list[Trajectory]) -> dict[str, list[Pose]]:
    """Poses by method for every test trajectory: the mean training pose, and the mean training pose at each frame."""
    position_m, rotation_camera_from_site = (
        np.concatenate([trajectory.pose[i] for trajectory in training]) for i in range(2)
    )
    mean_position_m, mean_rotation_camera_from_site = position_m.mean(0), mean_rotation(rotation_camera_from_site)
    constant = [
        constant_pose(mean_position_m, mean_rotation_camera_from_site, trajectory.n_pairs) for trajectory in test
    ]
    return {
        "mean_pose": constant,
        "mean_pose_at_frame": [_mean_pose_at_frame(training, trajectory.n_pairs) for trajectory in test],
    }


def constant_pose(position_m: Array, rotation_camera_from_site: Array, n_pairs: int) -> Pose:
    """One pose, repeated for every pair."""
    return np.tile(position_m, (n_pairs, 1)), np.tile(rotation_camera_from_site, (n_pairs, 1, 1))


def _mean_pose_at_frame(training: list[Trajectory], n_pairs: int) -> Pose:
    """Mean pose of the training set at each frame. Beyond the last frame of training, the last mean is repeated."""
    last, positions, rotations = max(trajectory.n_pairs for trajectory in training) - 1, [], []
    for step in np.minimum(np.arange(n_pairs), last):
        known = [trajectory.pose for trajectory in training if trajectory.n_pairs > step]
        positions.append(np.mean([pose[0][step] for pose in known], axis=0))
        rotations.append(mean_rotation(np.stack([pose[1][step] for pose in known])))
    return np.stack(positions), np.stack(rotations)


@dataclass(frozen=True)
class Known:
    """Trajectories together with features of their pairs."""

    trajectories: list[Trajectory]
    """The trajectories."""
    features: list[Array]
    """Features (pairs, inputs) of each trajectory."""


def ridge_poses(training: Known, validation: Known, features: list[Array]) -> list[Pose]:
    """Estimate poses of test trajectories from their features (pairs, inputs) by ridge regression.

    Features are standardised. The penalty is the one with the lowest squared position error on validation.
    """
    position_m, rotation_camera_from_site = (
        np.concatenate([trajectory.pose[i] for trajectory in training.trajectories]) for i in range(2)
    )
    turn = mean_rotation(rotation_camera_from_site)
    targets = np.concatenate([position_m, rotation_vectors(rotation_camera_from_site @ turn.T)], axis=1)
    fit = _Ridge(np.concatenate(training.features), targets)
    known = np.concatenate([trajectory.pose[0] for trajectory in validation.trajectories])
    unseen = fit.projected(np.concatenate(validation.features))
    costs = [np.sum((fit.targets(unseen, penalty)[:, :3] - known) ** 2) for penalty in _PENALTIES]
    best = _PENALTIES[int(np.argmin(costs))]
    predicted = [fit.targets(fit.projected(trajectory_features), best) for trajectory_features in features]
    return [
        (target[:, :3], np.stack([matrix_from_rotation_vector(vector) @ turn for vector in target[:, 3:]]))
        for target in predicted
    ]


class _Ridge:
    """Ridge regression from features (n, inputs) to targets (n, outputs), solved once for all penalties."""

    def __init__(self, features: Array, targets: Array):
        self.mean, spread = features.mean(0), features.std(0)
        self.scale = np.maximum(np.maximum(spread, 0.1 * spread.mean()), 1e-12)
        self.centre, standard = targets.mean(0), self._standardised(features)
        # If there are more features than pairs, the matrix of inner products is smaller.
        self.known = standard if features.shape[1] > len(features) else None
        gram = standard @ standard.T if self.known is not None else standard.T @ standard
        self.values, self.vectors = np.linalg.eigh(gram.astype(np.float64))
        right = targets - self.centre if self.known is not None else standard.T @ (targets - self.centre)
        self.right, self.unit = self.vectors.T @ right, float(np.mean(np.sum(standard**2, axis=1)))

    def projected(self, features: Array) -> Array:
        """Project features (n, inputs) onto the eigenvectors."""
        inner = self._standardised(features)
        return np.asarray((inner if self.known is None else inner @ self.known.T) @ self.vectors)

    def targets(self, projected: Array, penalty: float) -> Array:
        """Targets (n, outputs) for projected features, with a penalty in units of `_PENALTIES`."""
        shrunk = self.right / (np.maximum(self.values, 0) + penalty * self.unit)[:, None]
        return np.asarray(self.centre + projected @ shrunk)

    def _standardised(self, features: Array) -> Array:
        return np.asarray((features - self.mean) / self.scale)
