"""Other views of training trajectories: frames are warped over the ground plane to poses near the original ones."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from perilune_shared.geometry.frames import Array, matrix_from_rotation_vector, rotation_vectors
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.geometry import ground_homography
from perilune_train.motion.metrics.floors import mean_poses


def other_views(trajectories: list[Trajectory], count: int, spread: float, seed: int) -> list[Trajectory]:
    """`count` further versions of each training trajectory: the first version of all, then the second version of all.

    A version has other poses, but still the original images; `Windows` warps them. The pose of each frame is moved by
    `spread` times the deviation of a random training trajectory from the mean pose of that frame, with a random sign
    for each axis of position and attitude. So the moves change as smoothly from frame to frame as real deviations, and
    with `spread` 1 they are as large.
    """
    deviations, versions = _deviations(trajectories) if count else [], []
    for version in range(count):
        for number, trajectory in enumerate(trajectories):
            rng = np.random.default_rng([seed, version, number])
            moves = spread * rng.choice([-1.0, 1.0], 6) * deviations[rng.integers(len(deviations))]
            # If the random trajectory is shorter, repeat its last deviation.
            moves = moves[np.minimum(np.arange(len(trajectory.position_m)), len(moves) - 1)]
            turns = np.stack([matrix_from_rotation_vector(vector) for vector in moves[:, 3:]])
            rotation_camera_from_site = turns @ trajectory.rotation_camera_from_site
            versions.append(
                replace(
                    trajectory,
                    position_m=trajectory.position_m + moves[:, :3],
                    rotation_camera_from_site=rotation_camera_from_site,
                )
            )
    return versions


def _deviations(trajectories: list[Trajectory]) -> list[Array]:
    """Each trajectory's deviation (n, 6) from the mean pose of each frame: metres in O_L, rotation vector in O_C."""
    deviations = []
    for trajectory, (position_m, rotation) in zip(
        trajectories, mean_poses(trajectories, trajectories)["mean_pose_at_frame"], strict=True
    ):
        turns = rotation_vectors(trajectory.pose[1] @ np.swapaxes(rotation, 1, 2))
        pairs = np.concatenate([trajectory.pose[0] - position_m, turns], axis=1)
        # A pose belongs to the later frame of a pair, so the first frame has none. Move it like the second one.
        deviations.append(np.concatenate([pairs[:1], pairs]))
    return deviations


def view_homographies(trajectory: Trajectory, view: Trajectory) -> Tensor:
    """Homographies (n, 3, 3), float32, from image coordinates of a view to image coordinates of its trajectory.

    They are exact for points of the mean ground plane, z = 0 in O_L. A point at height h above the plane is displaced
    by about f h m / a^2 pixels, for a move by m metres, altitude a and focal length f.
    """
    from_ground, other = (
        ground_homography(trajectory.camera.matrix, poses.position_m, poses.rotation_camera_from_site)
        for poses in (trajectory, view)
    )
    return torch.from_numpy(from_ground @ np.linalg.inv(other)).float()
