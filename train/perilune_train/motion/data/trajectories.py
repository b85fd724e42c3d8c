"""Trajectories of a navigation dataset as arrays, with their nominal motion."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError
from perilune_shared.geometry.camera import Camera
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.geometry.inertial_grades import GRADES, InertialGrade
from perilune_shared.geometry.nominal_trajectory import NominalTrajectory
from perilune_train.data.frames import frame_table, load_images
from perilune_train.data.pinhole import check_pinhole
from perilune_train.data.shares import ALONE, Share
from perilune_train.motion.data.gyroscope import GyroscopeTurns, gyroscope_turns
from perilune_train.motion.data.undistort import undistorted
from perilune_train.motion.geometry import relative_poses

Motion = tuple[Array, Array]
"""Motions of one trajectory: translation_m (n - 1, 3), O_C of the earlier frame; rotation_c2_from_c1 (n - 1, 3, 3)."""
Pose = tuple[Array, Array]
"""Poses at the later frame of each pair: position_m (n - 1, 3), O_L; rotation_camera_from_site (n - 1, 3, 3)."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """One trajectory of n frames, with the nominal motion, which is known before the flight."""

    ids: tuple[str, str]
    """scene_id and trajectory_id."""
    split: str
    """train, val or test."""
    images: np.ndarray
    """8-bit grey frames (n, height, width); (0, height, width) if only another process loads them."""
    camera: Camera
    """Intrinsics of `images`."""
    position_m: Array
    """True camera positions (n, 3), metres, O_L."""
    rotation_camera_from_site: Array
    """True attitudes (n, 3, 3)."""
    nominal_position_m: Array
    """Positions (n, 3), metres, on the nominal curve at the frames' times, O_L."""
    nominal_rotation_camera_from_site: Array
    """Nominal attitude (3, 3) of the camera on a level body, equal for all frames."""
    gyroscopes: Mapping[InertialGrade, GyroscopeTurns] = field(default_factory=dict)
    """Rotations that a gyroscope measured, by grade. Has no grade that the dataset lacks; empty for training
    trajectories."""

    @property
    def n_pairs(self) -> int:
        """Number of pairs of consecutive frames."""
        return len(self.position_m) - 1

    @property
    def motion(self) -> Motion:
        """True motions: translation_m (n - 1, 3) and rotation_c2_from_c1 (n - 1, 3, 3)."""
        return relative_poses(self.position_m, self.rotation_camera_from_site)

    @property
    def pose(self) -> Pose:
        """True poses at the later frame of each pair: position_m (n - 1, 3) and rotation_camera_from_site."""
        return self.position_m[1:], self.rotation_camera_from_site[1:]

    @property
    def nominal_motion(self) -> Motion:
        """Nominal motions: translation_m (n - 1, 3), and rotation_c2_from_c1 (n - 1, 3, 3), always the identity."""
        attitudes = np.broadcast_to(self.nominal_rotation_camera_from_site, (len(self.position_m), 3, 3))
        return relative_poses(self.nominal_position_m, attitudes)

    @property
    def altitude_m(self) -> Array:
        """Nominal altitude (n - 1,), metres, above the ground plane at the earlier frame of each pair."""
        return self.nominal_position_m[:-1, 2]

    @property
    def down_c(self) -> Array:
        """Unit vector (3,) towards the ground in O_C, if the body is level."""
        return -self.nominal_rotation_camera_from_site[:, 2]

    def shrunk(self, size_px: int) -> "Trajectory":
        """Shrink the images to a width of `size_px` by area averaging; returns self if they have this width."""
        height, width = self.images.shape[1:]
        if width == size_px:
            return self
        scale = size_px / width
        new_height = round(height * scale)
        size = (size_px, new_height)
        images = np.empty((len(self.images), new_height, size_px), np.uint8)
        for image, small in zip(self.images, images, strict=True):
            cv2.resize(image, size, small, interpolation=cv2.INTER_AREA)
        c, down = self.camera, new_height / height
        camera = Camera(size_px, new_height, c.fx_px * scale, c.fy_px * down, c.cx_px * scale, c.cy_px * down)
        return replace(self, images=images, camera=camera)


def own_trajectories(split: str, count: int, share: Share) -> list[int]:
    """Numbers, from 0 to count - 1, of the trajectories of a split whose frames a process needs.

    Trajectories of train and val are divided among the processes. If val has fewer trajectories than there are
    processes, some processes validate on a shared trajectory. Only the first process evaluates test.
    """
    if split == "test":
        return list(range(count)) if share.process == 0 else []
    return list(share.of(count)) or ([share.process % count] if split == "val" else [])


def load_trajectories(dataset: Dataset, share: Share = ALONE) -> list[Trajectory]:
    """Load all trajectories of a navigation dataset: train, then val, then test, each in the order of their ids.

    If there are several processes, each loads only the frames that it needs (`own_trajectories`). Frames of a
    distorting lens are undistorted. Raises UserError if the dataset is of another kind or its camera has a lens model,
    if a frame is missing, or if there are fewer training trajectories than processes.
    """
    trajectories = [trajectory for split in SPLITS for trajectory in load_split(dataset, split, share)]
    if len({trajectory.ids for trajectory in trajectories}) < len(trajectories):
        raise UserError(dataset.store, "split", "a trajectory in two splits", "one split for each trajectory")
    return trajectories


def load_split(dataset: Dataset, split: str, share: Share = ALONE) -> list[Trajectory]:
    """Load the trajectories of one split in the order of their ids. Raises UserError like `load_trajectories`."""
    if dataset.info.kind != "nav":
        raise UserError(dataset.store, "kind", dataset.info.kind, "nav, a dataset of trajectories")
    check_pinhole(dataset)
    rows = dataset.table("trajectories").to_pylist()
    curves = {(row["scene_id"], row["trajectory_id"]): row for row in rows}
    return _split_trajectories(dataset, split, curves, share)


def _split_trajectories(
    dataset: Dataset, split: str, curves: dict[tuple[str, str], dict], share: Share
) -> list[Trajectory]:
    table = frame_table(dataset, split)
    groups = list(table.groupby(["scene_id", "trajectory_id"]))
    if split == "train" and len(groups) < share.processes:
        expected = f"at least {share.processes}, one for each process"
        raise UserError(dataset.store, "train trajectories", len(groups), expected)
    numbers = set(own_trajectories(split, len(groups), share))
    loaded = table.iloc[np.concatenate([[], *(groups[number][1].index for number in sorted(numbers))]).astype(int)]
    (images, camera), start = undistorted(load_images(dataset, loaded, split), dataset.camera), 0
    trajectories = []
    for number, (key, rows) in enumerate(groups):
        stop = start + (len(rows) if number in numbers else 0)
        scene_id, trajectory_id = (str(part) for part in key)
        curve = curves[scene_id, trajectory_id]
        nominal = NominalTrajectory(
            tuple(curve["nominal_position_m"]),
            tuple(curve["nominal_velocity_mps"]),
            tuple(curve["nominal_acceleration_mps2"]),
            float(curve["duration_s"]),
        )
        if len(rows) < 2:
            raise UserError(
                dataset.store, f"{scene_id}/{trajectory_id}", "one frame", "trajectories of at least two frames"
            )
        trajectories.append(
            Trajectory(
                (scene_id, trajectory_id),
                split,
                images[start:stop],
                camera,
                np.array(rows["position_m"].tolist()),
                matrix_from_quaternion(rows["rotation_wxyz"].tolist()),
                nominal.position_at(rows["time_s"].to_numpy()),
                np.array(dataset.info.camera.rotation_camera_from_body),
            )
        )
        start = stop
        if split != "train" and number in numbers:
            trajectories[-1] = replace(trajectories[-1], gyroscopes=_gyroscopes(dataset, trajectories[-1], rows))
    return trajectories


def _gyroscopes(dataset: Dataset, trajectory: Trajectory, rows: pd.DataFrame) -> dict[InertialGrade, GyroscopeTurns]:
    time_s, rotation_camera_from_site = rows["time_s"].to_numpy(), trajectory.nominal_rotation_camera_from_site
    measured = {
        grade: gyroscope_turns(dataset, trajectory.ids, grade, time_s, rotation_camera_from_site) for grade in GRADES
    }
    return {grade: turns for grade, turns in measured.items() if turns is not None}
