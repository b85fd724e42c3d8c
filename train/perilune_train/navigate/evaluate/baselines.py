"""The methods without training: KLT tracks, the nominal motion, and mean motions of the training set."""

import numpy as np

from perilune_shared.geometry.frames import Array
from perilune_shared.terminal import progress_bar
from perilune_train.navigate.data.trajectories import Motion, Trajectory
from perilune_train.navigate.evaluate.klt import klt_trajectory


def baselines(training: list[Trajectory], test: list[Trajectory]) -> dict[str, list[Motion]]:
    """Motions of the test trajectories by each method; without training trajectories there are no mean motions."""
    with progress_bar() as progress:
        task = progress.add_task("KLT baseline", total=len(test), unit="trajectories", note="")
        tracked = []
        for trajectory in test:
            tracked.append(klt_trajectory(trajectory))
            progress.advance(task)
    found = {"klt": tracked, "nominal": [trajectory.nominal_motion for trajectory in test]}
    if training:
        found["mean_at_step"] = [mean_motion_at_step(training, trajectory) for trajectory in test]
        found["mean"] = [mean_motion(training, trajectory) for trajectory in test]
    return found


def mean_motion(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The training set's mean motion, for every pair of the trajectory."""
    translation = np.concatenate([one.motion[0] for one in training]).mean(0)
    rotation = _mean_rotation(np.concatenate([one.motion[1] for one in training]))
    return np.tile(translation, (trajectory.n_pairs, 1)), np.tile(rotation, (trajectory.n_pairs, 1, 1))


def mean_motion_at_step(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The training set's mean motion at each step; that of its last step for all later steps."""
    translations, rotations = [], []
    longest = max(one.n_pairs for one in training)
    for step in range(trajectory.n_pairs):
        motions = [
            (one.motion[0][min(step, longest - 1)], one.motion[1][min(step, longest - 1)])
            for one in training
            if one.n_pairs > min(step, longest - 1)
        ]
        translations.append(np.mean([t for t, _ in motions], axis=0))
        rotations.append(_mean_rotation(np.stack([r for _, r in motions])))
    return np.stack(translations), np.stack(rotations)


def _mean_rotation(rotations: Array) -> Array:
    """The rotation nearest to the mean of the matrices (Moakher 2002, doi 10.1137/S0895479801383877)."""
    u, _, vt = np.linalg.svd(rotations.mean(0))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
