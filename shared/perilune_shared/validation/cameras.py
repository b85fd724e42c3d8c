"""Check frames of several cameras on one body: names of trajectories, and poses at one instant."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import trajectory_of_body, trajectory_of_camera
from perilune_shared.geometry.frames import matrix_from_quaternion
from perilune_shared.validation.faults import Fault

_TOLERANCE = 1e-6
"""Maximum difference between body poses from two cameras: position, metres; rotation matrix elements; time, s."""
_COLUMNS = ["frame_id", "trajectory_id", "frame_index", "time_s", "split", "position_m", "rotation_wxyz", "camera"]


def camera_faults(dataset: Dataset, scene_id: str, where: str) -> Iterator[Fault]:
    """Yield the faults of a scene's frames in a dataset with several cameras.

    `where` is the file of the frames. The pose of the body is computed from the pose and the mounting of each camera.
    Body pose, time and split must be equal for all cameras at one instant. Frames of unknown cameras are skipped;
    `trajectory_faults` reports them.
    """
    cameras = dataset.info.cameras or {}
    rows = dataset.table("frames", _COLUMNS, scene_id=scene_id).to_pandas()
    rows = rows[rows["camera"].isin(list(cameras))].reset_index(drop=True)
    if rows.empty:
        return
    rows["body"] = [trajectory_of_body(*names) for names in zip(rows["camera"], rows["trajectory_id"], strict=True)]
    for row in rows.itertuples():
        if row.trajectory_id != trajectory_of_camera(row.camera, row.body):
            expected = trajectory_of_camera(row.camera, row.trajectory_id)
            yield Fault.of(where, None, "trajectory_id", row.trajectory_id, f"{expected}, of the camera {row.camera}")
            return
    numbers = np.hstack([_body_poses(dataset, rows), rows[["time_s"]].to_numpy()])
    first = rows.groupby(["body", "frame_index"])["frame_id"].transform(lambda ids: ids.index[0]).to_numpy()
    with np.errstate(invalid="ignore"):
        off = np.abs(numbers - numbers[first]).max(axis=1)
    for row in np.flatnonzero(~(off <= _TOLERANCE))[:1]:
        other = rows["frame_id"][first[row]]
        expected = f"at most {_TOLERANCE:g}, with the mountings in dataset.json"
        found = f"a difference of {off[row]:.3g} between body pose or time of {rows['frame_id'][row]} and {other}"
        yield Fault.of(where, None, "position_m+rotation_wxyz", found, expected)
    splits = rows["split"].to_numpy()
    for row in np.flatnonzero(splits != splits[first])[:1]:
        yield Fault.of(where, None, "split", splits[row], f"{splits[first[row]]}, as in {rows['frame_id'][first[row]]}")


def _body_poses(dataset: Dataset, rows: pd.DataFrame) -> np.ndarray:
    """Return the body pose of each row (N, 12): position in O_L, metres, then rotation_site_from_body."""
    position = np.stack(rows["position_m"].to_list())
    rotation = matrix_from_quaternion(np.stack(rows["rotation_wxyz"].to_list()))
    records = [dataset.info.camera_of(name) for name in rows["camera"]]
    mounted = np.array([record.rotation_camera_from_body for record in records])
    position_in_body = np.array([record.position_in_body_m for record in records])
    site_from_body = np.einsum("nji,njk->nik", rotation, mounted)
    body = position - np.einsum("nij,nj->ni", site_from_body, position_in_body)
    return np.hstack([body, site_from_body.reshape(len(rows), 9)])
