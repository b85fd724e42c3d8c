"""Read a dataset descent by descent, for exports with a time line.

A descent is the part of a trajectory that belongs to the requested splits. Only one descent, without its images, is in
memory at a time; images are read in groups.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.metadata import CameraRecord
from perilune_shared.errors import UserError
from perilune_shared.export.rows import Choice
from perilune_shared.geometry.frames import Array, matrix_from_quaternion
from perilune_shared.storage.png import png_header

MAX_TIME_S = 1e8
"""Largest time of a frame or measurement, seconds."""
_FRAMES_AT_ONCE = 16
"""Packed frames come in the order of their shards, so images of this many frames are in memory at a time."""


@dataclass(frozen=True, slots=True)
class Descent:
    """Frames and labels of one descent."""

    scene_id: str
    """Id of the scene."""
    trajectory_id: str
    """Id of the trajectory within the scene."""
    frames: pd.DataFrame
    """Rows of the table `frames` in temporal order."""
    labels: dict[str, pd.DataFrame]
    """Selected rows of the table `labels` by frame_id; frames without a selected label are missing."""

    @property
    def name(self) -> str:
        """scene_id/trajectory_id."""
        return f"{self.scene_id}/{self.trajectory_id}"


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame with its image."""

    row: dict[str, Any]
    """Row of the table `frames`."""
    camera: CameraRecord
    """Camera and its mounting."""
    png: bytes
    """Image file."""
    bits: int
    """Bits per grey value of the image, 8 or 16."""
    position_m: Array
    """Position of the body's origin (3,), O_L, metres."""
    rotation_site_from_body: Array
    """Attitude of the body (3, 3)."""
    labels: pd.DataFrame
    """Selected labels of the frame."""


def descents_of(
    dataset: Dataset, split: str | None = None, choose: Choice | None = None, trajectory: str | None = None
) -> Iterator[Descent]:
    """Yield the descents of a dataset in order.

    `trajectory` is scene_id/trajectory_id of the only descent to read. Raises UserError if no frame belongs to the
    split, if there is no such trajectory, or if a time or pose is not a number within its limits.
    """
    n_frames = 0
    for scene_id, trajectory_id in _trajectories(dataset, trajectory):
        frames = dataset.table("frames", None, scene_id, trajectory_id, split).to_pandas()
        if frames.empty:
            continue
        n_frames += len(frames)
        frames = frames.sort_values(["time_s", "frame_id"], kind="stable", ignore_index=True)
        check_times(dataset, "frames", frames)
        poses = np.concatenate([np.stack(frames[name].to_list()) for name in ("position_m", "rotation_wxyz")], axis=1)
        bad = ~np.isfinite(poses).all(axis=1) | ~(np.linalg.norm(poses[:, 3:], axis=1) > 0.5)
        if bad.any():
            row = int(bad.argmax())
            where = f"frames: {frames['frame_id'][row]}: position_m, rotation_wxyz"
            raise UserError(dataset.store, where, poses[row].tolist(), "finite numbers, and a unit quaternion")
        labels = dataset.table("labels", None, scene_id, trajectory_id, split)
        rows = labels.to_pandas()
        if choose is not None:
            rows = rows[choose(dataset, scene_id, labels)]
        rows = rows.sort_values(["frame_id", "crater_id"], kind="stable")
        by_frame = {str(frame_id): group for frame_id, group in rows.groupby("frame_id")}
        yield Descent(scene_id, trajectory_id, frames, by_frame)
    if not n_frames:
        found = "none" if split is None else f"none of split {split}"
        raise UserError(dataset.store, "frames", found, "at least one frame")


def count_descent_frames(dataset: Dataset, split: str | None = None, trajectory: str | None = None) -> int:
    """Return the number of frames that `descents_of` yields, as the total of a progress bar.

    Raises UserError if there is no such trajectory.
    """
    if split is None and trajectory is None:
        return dataset.info.counts.frames
    scene_id, trajectory_id = (None, None) if trajectory is None else next(_trajectories(dataset, trajectory))
    return len(dataset.table("frames", ["frame_id"], scene_id, trajectory_id, split))


def shots_of(dataset: Dataset, descent: Descent) -> Iterator[Shot]:
    """Yield the frames of a descent with their images, in temporal order.

    Raises UserError if an image is missing, is not a grey PNG, or differs in size from its camera.
    """
    for start in range(0, len(descent.frames), _FRAMES_AT_ONCE):
        batch = descent.frames.iloc[start : start + _FRAMES_AT_ONCE]
        pngs = dict(dataset.pngs(pa.Table.from_pandas(batch[["frame_id", "png_path"]], preserve_index=False)))
        for row in batch.to_dict("records"):
            frame_id = str(row["frame_id"])
            camera = dataset.info.camera_of(row["camera"] if isinstance(row["camera"], str) else None)
            try:
                header = png_header(pngs[frame_id])
                if (header.width_px, header.height_px) != (camera.width_px, camera.height_px):
                    raise ValueError(f"{header.width_px} x {header.height_px} pixels")
            except ValueError as error:
                expected = f"a grey PNG of {camera.width_px} x {camera.height_px} pixels, as in dataset.json"
                raise UserError(frame_id, "image", error, expected) from None
            position_m, rotation = body_pose(row["position_m"], row["rotation_wxyz"], camera)
            labels = descent.labels.get(frame_id)
            shown = _no_labels() if labels is None else labels
            yield Shot(
                {str(k): v for k, v in row.items()}, camera, pngs[frame_id], header.bits, position_m, rotation, shown
            )


def body_pose(position_m: Any, rotation_wxyz: Any, camera: CameraRecord) -> tuple[Array, Array]:
    """Return position (3,), O_L, metres, and rotation_site_from_body (3, 3) of the body that carries a camera.

    `position_m` (3,) and `rotation_wxyz` (4,), rotation_camera_from_site, are the pose of the camera.
    """
    rotation = matrix_from_quaternion(rotation_wxyz).T @ np.array(camera.rotation_camera_from_body)
    return np.asarray(position_m, np.float64) - rotation @ np.array(camera.position_in_body_m), rotation


def measurements(dataset: Dataset, descent: Descent, table: str) -> pd.DataFrame:
    """Return the rows of `inertial` or `ranges` of a descent in temporal order. Raises UserError on invalid times."""
    rows = dataset.table(table, None, descent.scene_id, descent.trajectory_id).to_pandas()
    check_times(dataset, table, rows)
    return rows.sort_values("time_s", kind="stable", ignore_index=True)


def check_times(dataset: Dataset, table: str, rows: pd.DataFrame) -> None:
    """Raise UserError unless all times of a table are numbers within MAX_TIME_S."""
    time_s = rows["time_s"].to_numpy(np.float64)
    bad = ~(np.abs(time_s) <= MAX_TIME_S)
    if bad.any():
        expected = f"a number of seconds, at most {MAX_TIME_S:g}"
        raise UserError(dataset.store, f"{table}: time_s", time_s[bad.argmax()], expected)


def _trajectories(dataset: Dataset, trajectory: str | None) -> Iterator[tuple[str, str]]:
    for scene_id in dataset.scene_ids() if trajectory is None else [_ids(trajectory)[0]]:
        known = sorted(dataset.table("trajectories", ["trajectory_id"], scene_id)["trajectory_id"].to_pylist())
        if trajectory is not None:
            known = [each for each in known if each == _ids(trajectory)[1]]
            if not known:
                rows = dataset.table("trajectories", ["scene_id", "trajectory_id"]).to_pylist()
                first = ", ".join("/".join(row.values()) for row in rows[:3])
                raise UserError("--trajectory", "", trajectory, f"one of {len(rows)} of the dataset: {first} ...")
        for trajectory_id in known:
            yield scene_id, trajectory_id


def _ids(trajectory: str) -> tuple[str, str]:
    scene_id, _, trajectory_id = trajectory.partition("/")
    return scene_id, trajectory_id


@functools.cache
def _no_labels() -> pd.DataFrame:
    from perilune_shared.dataset.schema import TABLES

    return TABLES["labels"].empty_table().to_pandas()
