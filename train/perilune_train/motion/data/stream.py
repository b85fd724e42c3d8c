"""Rendered trajectories of an image server for the navigator."""

from dataclasses import replace

import numpy as np

from perilune_shared.client import SceneClient
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.geometry.frames import Array, quaternion_from_matrix
from perilune_train.data.image_server import ImageServer
from perilune_train.motion.config import StreamConfig
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.data.undistort import undistorted


class Stream(ImageServer):
    """The image server of a navigation run, with the velocities of the training trajectories.

    Raises UserError if the server does not answer or does not fit the navigation dataset.
    """

    settings: StreamConfig

    def __init__(self, settings: StreamConfig, dataset: Dataset):
        super().__init__(settings, dataset, "navigate.stream")
        self._velocities = _velocities(dataset)

    def velocities_mps(self, ids: tuple[str, str]) -> Array:
        """Velocities (n, 3), O_L, metres per second, of a training trajectory."""
        return self._velocities[ids]

    def rendered(self, client: SceneClient, scene: int, part: Trajectory, velocity: Array, index: int) -> Trajectory:
        """Return the n poses of `part` with rendered images of a scene.

        `velocity` (n, 3) sets the motion blur of the images, and `index` sets their noise. Meanwhile the server
        generates the scene after this one. Raises UserError if the server fails or the terrain is held out.
        """
        self.record(client, scene)
        following = self.following(scene)
        if following is not None:
            client.ground(following, wait=False)
        images = []
        for k, position in enumerate(part.position_m):
            rotation_wxyz = quaternion_from_matrix(part.rotation_camera_from_site[k])
            frame = client.frame(position, rotation_wxyz, velocity_mps=velocity[k], index=index + k, scene=scene)
            images.append(self.checked(frame.image))
        pixels, camera = undistorted(np.stack(images), self.served.camera)
        return replace(part, images=pixels, camera=camera)


def _velocities(dataset: Dataset) -> dict[tuple[str, str], Array]:
    """Velocities (n, 3) of each training trajectory, by scene_id and trajectory_id."""
    columns = ["scene_id", "trajectory_id", "frame_index", "velocity_mps"]
    table = dataset.table("frames", columns, split="train").to_pandas().sort_values(columns[:3])
    groups = table.groupby(["scene_id", "trajectory_id"])
    return {(str(key[0]), str(key[1])): np.array(rows["velocity_mps"].tolist()) for key, rows in groups}
