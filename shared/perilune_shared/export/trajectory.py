"""Export trajectories to the formats of TUM and KITTI, one file per trajectory.

evo and the tools of both benchmarks read these files. A pose is the pose of the camera: the position of the centre of
projection, and the rotation from O_C (x right, y down, z along the viewing direction) to the reference frame. For the
reference frame O_L, this is rotation_site_from_camera.

- TUM (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats): `timestamp tx ty tz qx qy qz qw`, reference O_L.
- KITTI (https://www.cvlibs.net/datasets/kitti/eval_odometry.php): the upper 3x4 of the pose matrix, row by row; the
reference is the first camera pose of the file, so the first line is the identity. Times are in a second file.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from perilune_shared.console.progress import Progress
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.export.rows import count_scenes, scenes_of
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_files
from perilune_shared.storage.store import Address

_TUM_HEADER = (
    "# camera poses of one trajectory: centre of projection in O_L (X west, Y south, Z up), metres;\n"
    "# rotation_site_from_camera (camera: x right, y down, z forward); seconds since the first frame\n"
    "# frame: O_L\n"
    "# timestamp tx ty tz qx qy qz qw\n"
)


def export_tum(dataset: Dataset, out: Address, progress: Progress, split: str | None = None) -> int:
    """Write `out`/<scene_id>/<trajectory_id>.txt for each trajectory, in TUM's format.

    Returns the number of trajectories. With `split`, writes only frames of that split. Raises UserError if `out` is not
    empty or the split has no frames.
    """
    n_trajectories = 0
    with new_files(out) as folder:
        for scene_id, trajectory_id, frames in _trajectories(dataset, progress, "tum", split):
            # The manifest contains rotation_camera_from_site; TUM needs its inverse, the conjugate quaternion.
            w, x, y, z = np.stack(frames["rotation_wxyz"].to_list()).T
            rows = np.column_stack([frames["time_s"], np.stack(frames["position_m"].to_list()), -x, -y, -z, w])
            path = files.inside(folder, f"{scene_id}/{trajectory_id}.txt")
            files.write_text(path, _TUM_HEADER + _lines(rows))
            n_trajectories += 1
    return n_trajectories


def export_kitti(dataset: Dataset, out: Address, progress: Progress, split: str | None = None) -> int:
    """Write the poses and times of each trajectory in KITTI's format; return the number of trajectories.

    Files: `out`/<scene_id>/<trajectory_id>.txt and <trajectory_id>.times.txt. With `split`, writes only frames of that
    split. Raises UserError if `out` is not empty or the split has no frames.
    """
    n_trajectories = 0
    with new_files(out) as folder:
        for scene_id, trajectory_id, frames in _trajectories(dataset, progress, "kitti", split):
            poses = poses_site_from_camera(frames)
            relative = np.linalg.inv(poses[0]) @ poses
            path = files.inside(folder, f"{scene_id}/{trajectory_id}.txt")
            files.write_text(path, _lines(relative[:, :3].reshape(-1, 12)))
            files.write_text(path.with_suffix(".times.txt"), _lines(frames["time_s"].to_numpy()[:, None]))
            n_trajectories += 1
    return n_trajectories


def poses_site_from_camera(frames: pd.DataFrame) -> Array:
    """Return the camera poses of N rows of the table `frames`: matrices (N, 4, 4) from O_C to O_L, metres."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = matrix_from_quaternion(np.stack(frames["rotation_wxyz"].to_list())).swapaxes(1, 2)
    poses[:, :3, 3] = np.stack(frames["position_m"].to_list())
    return poses


def _trajectories(
    dataset: Dataset, progress: Progress, task_name: str, split: str | None
) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Yield scene_id, trajectory_id and frames in temporal order, for each trajectory."""
    task = progress.add_task(task_name, total=count_scenes(dataset, split), unit="scenes")
    for scene in scenes_of(dataset, split, with_labels=False):
        for trajectory_id, frames in scene.frames.groupby("trajectory_id"):
            yield scene.scene_id, str(trajectory_id), frames.sort_values("frame_index")
        progress.advance(task)


def _lines(rows: Array) -> str:
    # repr returns the shortest text that parses to the same number; adding 0.0 avoids "-0.0".
    return "".join(" ".join(repr(float(value) + 0.0) for value in row) + "\n" for row in rows)
