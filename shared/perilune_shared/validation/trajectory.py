"""Check one trajectory: its frames, its labels, and the times of its measurements."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.metadata import CameraRecord, DatasetInfo
from perilune_shared.dataset.names import IMAGE_KINDS
from perilune_shared.dataset.schema import ANGULAR_VELOCITY
from perilune_shared.geometry.ellipse import Ellipses, project_circles
from perilune_shared.geometry.frames import Array, matrix_from_quaternion, sun_direction
from perilune_shared.geometry.rolling_shutter import Moving
from perilune_shared.validation.faults import Fault

_LABEL_TOLERANCE_PX = 1e-6
_LABEL_ROUNDING = 2.0**-23
"""Tolerance for labels that were rounded to float32, relative: twice the maximum rounding error."""
_SUN_TOLERANCE = 1e-9
_FARTHEST_M = 1e9
_TIME_TOLERANCE_S = 1e-6
_CAMERA = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
_BOX = ("bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px")


@dataclass(frozen=True, slots=True)
class TrajectoryRows:
    """A trajectory of a dataset and the rows that belong to it."""

    scene: dict
    """Row of the table `scenes`."""
    craters: pa.Table
    """Craters of the scene."""
    trajectory: dict
    """Row of the table `trajectories`."""
    frames: pa.Table
    """Frames of the trajectory."""
    labels: pa.Table
    """Labels of these frames."""
    where: dict[str, str]
    """Files to name in faults, by table (`frames` or `labels`)."""


def trajectory_faults(info: DatasetInfo, rows: TrajectoryRows) -> Iterator[Fault]:
    """Yield the faults of a trajectory's frames and labels.

    Frames are compared with the scene and the camera, labels with craters and poses.
    """
    frames, where = rows.frames, rows.where
    names = frames["camera"].unique().to_pylist()
    if info.cameras is not None and (len(names) != 1 or names[0] not in info.cameras):
        if names:
            expected = f"one camera in a trajectory, of {', '.join(info.cameras)}"
            yield Fault.of(where["frames"], None, "camera", names, expected)
        return
    camera = info.camera_of(names[0] if names else None)
    yield from _frames(info, camera, rows.scene, rows.trajectory, frames, where["frames"])
    if len(rows.labels):
        yield from _labels(camera, info.row_time_s(rows.scene["recipe"]), rows.craters, frames, rows.labels, where)


def _frames(
    info: DatasetInfo, camera: CameraRecord, scene: dict, trajectory: dict, frames: pa.Table, where: str
) -> Iterator[Fault]:
    key = f"{trajectory['scene_id']}/{trajectory['trajectory_id']}"
    if len(frames) != trajectory["n_frames"]:
        expected = f"{len(frames)}, the number of frames of {key}"
        yield Fault.of("manifest/trajectories", None, "n_frames", trajectory["n_frames"], expected)
    if not len(frames):
        return
    splits = set(frames["split"].to_pylist())
    if trajectory["split"] != (splits.pop() if len(splits) == 1 else None):
        yield Fault.of("manifest/trajectories", None, "split", trajectory["split"], f"the split of the frames of {key}")
    if trajectory["split"] is None and info.split_by != "frame":
        yield Fault.of("dataset.json", None, "split_by", info.split_by, f"frame: {key} is in several splits")
    index = frames["frame_index"].to_numpy()
    ids = frames["frame_id"].to_pylist()
    for row, (frame_id, number) in enumerate(zip(ids, index.tolist(), strict=True)):
        if frame_id != f"{key}/{number:06d}":
            yield Fault.of(where, row, "frame_id", frame_id, f"{key}/{number:06d}")
            break
    time = frames["time_s"].to_numpy()
    order = np.argsort(index)
    if (np.diff(time[order]) <= 0).any():
        yield Fault.of(where, None, "time_s", "not increasing with frame_index", "increasing times")
    for name in _CAMERA:
        wrong = np.flatnonzero(frames[name].to_numpy() != getattr(camera, name))
        if len(wrong):
            found = frames[name][int(wrong[0])].as_py()
            yield Fault.of(where, int(wrong[0]), name, found, f"{getattr(camera, name)}, the dataset's camera")
    sun = sun_direction(scene["sun_azimuth_deg"], scene["sun_elevation_deg"])
    wrong = np.flatnonzero(np.abs(_vectors(frames["sun_direction"]) - sun).max(axis=1) > _SUN_TOLERANCE)
    if len(wrong):
        found = frames["sun_direction"][int(wrong[0])].as_py()
        yield Fault.of(where, int(wrong[0]), "sun_direction", found, f"{sun.tolist()}, the scene's Sun")
    for kind in IMAGE_KINDS:
        hashed = np.asarray(frames[f"{kind}_sha256"].is_valid())
        sized = np.asarray(frames[f"{kind}_bytes"].is_valid())
        wrong = np.flatnonzero(hashed != sized)
        if info.images in ("files", "packed") and kind == "png":
            wrong = np.flatnonzero(~hashed | ~sized)
        if kind != "png":
            wrong = np.flatnonzero((hashed != sized) | (hashed & ~np.asarray(frames[f"{kind}_path"].is_valid())))
        if len(wrong):
            yield Fault.of(where, int(wrong[0]), f"{kind}_sha256", "null", "path, hash and size together")


def _labels(
    camera: CameraRecord,
    row_s: float,
    craters: pa.Table,
    frames: pa.Table,
    labels: pa.Table,
    files: dict[str, str],
) -> Iterator[Fault]:
    """Check the keys of labels, and compare their ellipses with ellipses projected from crater and pose."""
    where = files["labels"]
    frame_of = _row_numbers(labels["frame_id"], frames["frame_id"])
    crater_of = _row_numbers(labels["crater_id"], craters["crater_id"])
    for name, found_at in (("frame_id", frame_of), ("crater_id", crater_of)):
        unknown = np.flatnonzero(found_at < 0)
        if len(unknown):
            found = labels[name][int(unknown[0])].as_py()
            yield Fault.of(where, int(unknown[0]), name, found, f"a row of {name.removesuffix('_id')}s")
    for name in ("scene_id", "split") if len(frames) else ():
        expected = frames[name].take(pa.array(np.maximum(frame_of, 0)))
        wrong = np.flatnonzero(~np.asarray(pc.equal(labels[name], expected), bool) & (frame_of >= 0))
        if len(wrong):
            row = int(wrong[0])
            yield Fault.of(where, row, name, labels[name][row].as_py(), f"{expected[row].as_py()}, as in its frame")
    known = np.flatnonzero((frame_of >= 0) & (crater_of >= 0))
    if not len(known):
        return
    projected = _projected(camera, row_s, craters, frames, crater_of[known], frame_of[known])
    size = 1 + projected["ellipse_a_px"]
    misfit = np.zeros(len(known), bool)
    for name, values in projected.items():
        error = np.abs(labels[name].to_numpy()[known] - values)
        tolerance = _LABEL_TOLERANCE_PX * size + _LABEL_ROUNDING * np.abs(values)
        if name == "ellipse_theta_rad":
            # The direction has period pi and is undefined for a circle.
            error = np.minimum(error, np.pi - error) * np.minimum(1, size - 1 - projected["ellipse_b_px"])
        wrong = np.flatnonzero(~(error < tolerance))
        misfit[wrong] = True
        if len(wrong):
            row = int(known[wrong[0]])
            expected = f"{values[wrong[0]]}, projected from crater and pose"
            yield Fault.of(where, row, name, labels[name][row].as_py(), expected)
    # If a frame has several labels and all are wrong, the pose is probably wrong: report the pose too.
    n_labels = np.bincount(frame_of[known], minlength=len(frames))
    n_misfits = np.bincount(frame_of[known[misfit]], minlength=len(frames))
    odd = np.flatnonzero((n_labels > 1) & (n_misfits == n_labels))
    if len(odd):
        found = f"a pose that matches none of {n_labels[odd[0]]} labels"
        yield Fault.of(
            files["frames"],
            int(odd[0]),
            "position_m+rotation_wxyz",
            found,
            "a pose that matches its labels",
        )


def _projected(
    camera: CameraRecord,
    row_s: float,
    craters: pa.Table,
    frames: pa.Table,
    crater_of: np.ndarray,
    frame_of: np.ndarray,
) -> dict[str, Array]:
    """Return the geometric columns of M labels, each (M,), computed from craters and poses.

    `crater_of` and `frame_of` (M,) are row numbers in `craters` and `frames`. With a rolling shutter (`row_s` seconds
    from row to row), a crater is projected from the camera pose at the exposure of the row that shows its centre.
    """
    rotation = matrix_from_quaternion(_vectors(frames["rotation_wxyz"]))[frame_of]
    centre = np.stack([craters[f"{axis}_m"].to_numpy() for axis in "xyz"], axis=1)[crater_of]
    normal = np.stack([craters[f"normal_{axis}"].to_numpy() for axis in "xyz"], axis=1)[crater_of]
    position = _vectors(frames["position_m"])[frame_of]
    if row_s:
        turn = np.stack([pc.fill_null(frames[name], 0.0).to_numpy() for name in ANGULAR_VELOCITY], axis=1)
        moving = Moving(position, rotation, _vectors(frames["velocity_mps"])[frame_of], turn[frame_of])
        with np.errstate(all="ignore"):
            time = moving.row_times_s(centre, camera.intrinsics(), row_s)
            rotation, position = moving.rotations_at(time), position + time[:, None] * moving.velocity_mps
    in_camera = np.einsum("nij,nj->ni", rotation, centre - position)
    normal_in_camera = np.einsum("nij,nj->ni", rotation, normal)
    radius = craters["diameter_m"].to_numpy()[crater_of] / 2
    valid = (np.abs(in_camera) < _FARTHEST_M).all(axis=1) & (np.abs(normal_in_camera) <= 2).all(axis=1)
    valid &= (radius > 0) & (radius < _FARTHEST_M)
    # Replace invalid input by a circle behind the camera, whose projection is NaN, so that the label does not match.
    in_camera[~valid], normal_in_camera[~valid], radius[~valid] = (0, 0, -10), (0, 0, 1), 1
    with np.errstate(all="ignore"):
        try:
            ellipses = project_circles(camera.intrinsics(), in_camera, normal_in_camera, radius)
        except np.linalg.LinAlgError:
            ellipses = Ellipses(*np.full((5, len(radius)), np.nan))
    names = ("cx_px", "cy_px", "a_px", "b_px", "theta_rad")
    columns = {f"ellipse_{name}": getattr(ellipses, name) for name in names}
    boxes = dict(zip(_BOX, ellipses.bounding_boxes().T, strict=True))
    return columns | boxes | {"radius_px": ellipses.radius_px()}


def _row_numbers(values: pa.ChunkedArray, within: pa.ChunkedArray) -> np.ndarray:
    """Return the row number of each value in the column `within` (M,); -1 if it is missing."""
    numbers = pc.index_in(values, within.combine_chunks())
    return pc.fill_null(numbers, -1).to_numpy().astype(np.int64)


def _vectors(column: pa.ChunkedArray) -> Array:
    """Return a column of fixed-size lists as an array (N, k)."""
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return flat.reshape(len(column), -1)


def measurement_faults(table: str, rows: pa.Table, trajectory: dict) -> Iterator[Fault]:
    """Yield the faults of a trajectory's rows of a table of measurements.

    `trajectory` is the row of the trajectory. For each grade of inertial unit and each beam of a lidar, times must
    increase and must not exceed the duration of the trajectory. The intervals of inertial measurements must follow each
    other without gaps.
    """
    where, key = f"manifest/{table}", f"{trajectory['scene_id']}/{trajectory['trajectory_id']}"
    series = next((name for name in ("grade", "beam") if name in rows.column_names), None)
    for value in [None] if series is None else rows[series].unique().to_pylist():
        of_series = rows if series is None else rows.filter(pc.equal(rows[series], value))
        time = of_series["time_s"].to_numpy()
        if (np.diff(time) <= 0).any():
            yield Fault.of(where, None, "time_s", f"not increasing in {key}", "increasing times")
        last = float(time.max())
        if last > trajectory["duration_s"] + _TIME_TOLERANCE_S:
            expected = f"at most {trajectory['duration_s']}, the duration of {key}"
            yield Fault.of(where, None, "time_s", last, expected)
        if "interval_s" not in rows.column_names:
            continue
        begin = np.concatenate([[0.0], time[:-1]])
        wrong = np.flatnonzero(np.abs(time - begin - of_series["interval_s"].to_numpy()) > _TIME_TOLERANCE_S)
        if len(wrong):
            found = f"{of_series['interval_s'][int(wrong[0])].as_py()} s before {time[wrong[0]]} s in {key}"
            yield Fault.of(where, None, "interval_s", found, f"{time[wrong[0]] - begin[wrong[0]]}, without a gap")
