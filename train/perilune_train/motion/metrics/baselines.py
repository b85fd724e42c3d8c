"""Methods without a network: KLT tracks, direct alignment, the nominal motion, mean motions of the training set."""

import time
from dataclasses import dataclass

import numpy as np

from perilune_shared.console.terminal import progress_bar
from perilune_shared.geometry.frames import Array
from perilune_shared.geometry.inertial_grades import InertialGrade
from perilune_train.motion.classical.alignment import aligned_trajectory
from perilune_train.motion.classical.estimate import EstimatedMotion
from perilune_train.motion.classical.klt import klt_trajectory
from perilune_train.motion.data.trajectories import Motion, Trajectory
from perilune_train.motion.geometry import mean_rotation

GYROSCOPE: InertialGrade = "tactical"
"""Grade of the inertial unit that provides the rotations of `klt_gyroscope` and `alignment_gyroscope`."""

ALIGNMENT = "alignment"
"""The default method of relative motion, used if no run of a network is given."""

CLASSICAL = ("klt", "klt_gyroscope", ALIGNMENT, "alignment_gyroscope")
"""Methods that read the images, in the order of the tables."""


@dataclass(frozen=True, slots=True)
class MethodMotions:
    """Motions that each method estimates for trajectories, and their covariances if the method computes them."""

    motions: dict[str, list[Motion]]
    """Motions of each trajectory, by method."""
    covariances: dict[str, list[Array]]
    """Covariances (n - 1, 6, 6) of each trajectory, as in `EstimatedMotion`, by method."""


def baselines(training: list[Trajectory], test: list[Trajectory]) -> MethodMotions:
    """Estimate the motions of test trajectories by all methods.

    Mean motions are left out if there are no training trajectories; methods with a gyroscope are left out if the
    dataset has no gyroscope.
    """
    with progress_bar() as progress:
        task = progress.add_task("classical methods", total=len(test), unit="trajectories", note="")
        estimated: dict[str, list[EstimatedMotion]] = {}
        for trajectory in test:
            gyroscope = trajectory.gyroscopes.get(GYROSCOPE)
            for name, method in (("klt", klt_trajectory), (ALIGNMENT, aligned_trajectory)):
                estimated.setdefault(name, []).append(method(trajectory))
                if gyroscope is not None:
                    estimated.setdefault(f"{name}_gyroscope", []).append(method(trajectory, gyroscope))
            progress.advance(task)
    whole = {name: estimated[name] for name in CLASSICAL if len(estimated.get(name, [])) == len(test)}
    motions = {name: [estimate.motion for estimate in estimates] for name, estimates in whole.items()}
    covariances = {name: [estimate.covariance for estimate in estimates] for name, estimates in whole.items()}
    motions["nominal"] = [trajectory.nominal_motion for trajectory in test]
    if training:
        motions["mean_at_step"] = [mean_motion_at_step(training, trajectory) for trajectory in test]
        motions["mean"] = [mean_motion(training, trajectory) for trajectory in test]
    return MethodMotions(motions, covariances)


def alignment_ms_per_pair(trajectory: Trajectory) -> float:
    """Time that alignment takes for one pair of frames of a trajectory, milliseconds."""
    started = time.monotonic()
    aligned_trajectory(trajectory)
    return round(1e3 * (time.monotonic() - started) / trajectory.n_pairs, 2)


def mean_motion(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The mean motion of the training set, repeated for every pair of the trajectory."""
    translation = np.concatenate([trajectory.motion[0] for trajectory in training]).mean(0)
    rotation_c2_from_c1 = mean_rotation(np.concatenate([trajectory.motion[1] for trajectory in training]))
    return np.tile(translation, (trajectory.n_pairs, 1)), np.tile(rotation_c2_from_c1, (trajectory.n_pairs, 1, 1))


def mean_motion_at_step(training: list[Trajectory], trajectory: Trajectory) -> Motion:
    """The mean motion of the training set at each step. Beyond the last step of training, the last mean is repeated."""
    translations, rotations = [], []
    longest = max(trajectory.n_pairs for trajectory in training)
    for step in range(trajectory.n_pairs):
        motions = [
            (trajectory.motion[0][min(step, longest - 1)], trajectory.motion[1][min(step, longest - 1)])
            for trajectory in training
            if trajectory.n_pairs > min(step, longest - 1)
        ]
        translations.append(np.mean([t for t, _ in motions], axis=0))
        rotations.append(mean_rotation(np.stack([r for _, r in motions])))
    return np.stack(translations), np.stack(rotations)
