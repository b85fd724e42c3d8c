"""Checks of a whole dataset: every fault with file, row, column, what was found and what was wanted."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
from rich.progress import Progress

from perilune_shared import files
from perilune_shared.camera import camera_from_site
from perilune_shared.ellipse import project_circles
from perilune_shared.errors import UserError
from perilune_shared.frames import matrix_from_quaternion
from perilune_shared.manifest import Dataset, read_part
from perilune_shared.schema import SCHEMA_VERSION, SPLITS, TABLES

_KEYS = {
    "scenes": ["scene_id"],
    "craters": ["scene_id", "crater_id"],
    "boulders": ["scene_id", "boulder_id"],
    "trajectories": ["scene_id", "trajectory_id"],
    "frames": ["frame_id"],
    "labels": ["frame_id", "crater_id"],
}
_POSITIVE = (
    "diameter_m",
    "extent_m",
    "ellipse_a_px",
    "ellipse_b_px",
    "radius_px",
    "duration_s",
    "n_frames",
    "width_px",
    "height_px",
    "fx_px",
    "fy_px",
    "png_bytes",
)
_RANGES = {
    "latitude_deg": (-90, 90),
    "longitude_deg": (-180, 180),
    "sun_elevation_deg": (-90, 90),
    "visible_fraction": (0, 1),
    "sunlit_fraction": (0, 1),
    "age_myr": (0, 4600),
    "ellipse_theta_rad": (0, np.pi),
}
_UNIT_VECTORS = ("rotation_wxyz", "sun_direction")
_LABEL_TOLERANCE_PX = 1e-6


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong in a dataset."""

    file: str
    """Relative to the dataset."""
    row: int | None
    """Row within the table, from 0; None where the fault is the whole file's."""
    column: str
    """Column or property."""
    found: str
    """The value."""
    wanted: str
    """What would be right."""


def validate(dataset: Dataset, progress: Progress | None = None) -> list[Fault]:
    """All faults of a dataset; an empty list means that it can be trusted."""
    faults: list[Fault] = []
    tables: dict[str, pd.DataFrame] = {}
    for name in TABLES:
        pieces = []
        for part in dataset.parts(name):
            where = part.relative_to(dataset.root).as_posix()
            try:
                piece = read_part(part, name)
            except UserError as error:
                faults.append(Fault(where, None, "part", str(error), "a readable part of this schema"))
                continue
            if not piece.schema.equals(TABLES[name]):
                faults.append(
                    Fault(where, None, "schema", str(piece.schema)[:80], f"the schema of version {SCHEMA_VERSION}")
                )
                continue
            pieces.append(piece)
            faults += _values(where, piece)
        tables[name] = (pa.concat_tables(pieces) if pieces else TABLES[name].empty_table()).to_pandas()
    faults += _keys(tables)
    faults += _counts(dataset, tables)
    faults += _splits(dataset, tables)
    if not faults:
        faults += _labels(dataset, tables)
    faults += _files(dataset, tables["frames"], progress)
    return faults


def _values(where: str, piece: pa.Table) -> Iterator[Fault]:
    """Ranges, finiteness and unit lengths within one part."""
    for field in piece.schema:
        column = piece[field.name]
        if not field.nullable and column.null_count:
            row = column.is_null().to_pylist().index(True)
            yield Fault(where, row, field.name, "null", "a value")
            continue
        if pa.types.is_fixed_size_list(field.type):
            values = np.array(column.to_pylist(), np.float64).reshape(len(column), field.type.list_size)
        elif pa.types.is_floating(field.type) or pa.types.is_integer(field.type):
            values = column.to_pandas().to_numpy(np.float64)[:, None]
        else:
            continue
        checks = [(~np.isfinite(values).all(axis=1) & ~column.is_null().to_numpy(), "a finite number")]
        if field.name in _POSITIVE:
            checks.append((values[:, 0] <= 0, "above 0"))
        if field.name in _RANGES:
            low, high = _RANGES[field.name]
            checks.append(((values[:, 0] < low) | (values[:, 0] > high), f"{low} to {high}"))
        if field.name in _UNIT_VECTORS:
            checks.append((np.abs(np.linalg.norm(values, axis=1) - 1) > 1e-6, "length 1"))
        for wrong, wanted in checks:
            if wrong.any():
                row = int(np.argmax(wrong))
                yield Fault(where, row, field.name, str(values[row].tolist()), wanted)


def _keys(tables: dict[str, pd.DataFrame]) -> Iterator[Fault]:
    """Unique ids and foreign keys."""
    for name, key in _KEYS.items():
        doubled = tables[name].duplicated(key)
        if doubled.any():
            row = int(np.argmax(doubled))
            yield Fault(f"manifest/{name}", row, "+".join(key), str(tables[name][key].iloc[row].tolist()), "unique")
    references = [
        ("craters", "scenes", ["scene_id"]),
        ("boulders", "scenes", ["scene_id"]),
        ("trajectories", "scenes", ["scene_id"]),
        ("frames", "trajectories", ["scene_id", "trajectory_id"]),
        ("labels", "frames", ["frame_id"]),
    ]
    for name, target, key in references:
        known = pd.MultiIndex.from_frame(tables[target][key])
        missing = ~pd.MultiIndex.from_frame(tables[name][key]).isin(known)
        if missing.any():
            row = int(np.argmax(missing))
            yield Fault(
                f"manifest/{name}",
                row,
                "+".join(key),
                str(tables[name][key].iloc[row].tolist()),
                f"in {target}",
            )
    labelled = tables["labels"][["frame_id", "crater_id"]].merge(
        tables["frames"][["frame_id", "scene_id"]], on="frame_id"
    )
    unknown = ~np.asarray(
        pd.MultiIndex.from_frame(labelled[["scene_id", "crater_id"]]).isin(
            pd.MultiIndex.from_frame(tables["craters"][["scene_id", "crater_id"]])
        )
    )
    if unknown.any():
        row = int(np.argmax(unknown))
        yield Fault("manifest/labels", row, "crater_id", str(labelled.loc[row, "crater_id"]), "in craters")


def _counts(dataset: Dataset, tables: dict[str, pd.DataFrame]) -> Iterator[Fault]:
    if not dataset.info.complete:
        yield Fault("dataset.json", None, "complete", "False", "a finished dataset; run `make dataset` again to go on")
    for name, table in tables.items():
        counted = getattr(dataset.info.counts, name)
        if counted != len(table):
            yield Fault("dataset.json", None, f"counts.{name}", str(counted), f"{len(table)}, the rows present")
    frames = tables["frames"].groupby(["scene_id", "trajectory_id"]).size()
    for row, planned in enumerate(tables["trajectories"].itertuples()):
        present = int(frames.get((planned.scene_id, planned.trajectory_id), 0))
        if present != planned.n_frames:
            yield Fault(
                "manifest/trajectories",
                row,
                "n_frames",
                str(planned.n_frames),
                f"{present}, the frames present",
            )


def _splits(dataset: Dataset, tables: dict[str, pd.DataFrame]) -> Iterator[Fault]:
    """No scene, or no trajectory, in two splits, as dataset.json promises."""
    frames = tables["frames"]
    unknown = ~frames["split"].isin(SPLITS)
    if unknown.any():
        row = int(np.argmax(unknown))
        yield Fault("manifest/frames", row, "split", str(frames.loc[row, "split"]), ", ".join(SPLITS))
    key = {"scene": ["scene_id"], "trajectory": ["scene_id", "trajectory_id"], "frame": ["frame_id"]}
    shared = frames.groupby(key[dataset.info.split_by])["split"].nunique() > 1
    if shared.any():
        yield Fault(
            "manifest/frames",
            None,
            "split",
            str(shared.index[int(np.argmax(shared))]),
            f"one split for each {dataset.info.split_by}",
        )


def _labels(dataset: Dataset, tables: dict[str, pd.DataFrame], n_sampled: int = 2000) -> Iterator[Fault]:
    """Ellipses of a sample of labels, projected again from crater and pose."""
    labels = tables["labels"]
    if labels.empty:
        return
    camera = dataset.info.camera.intrinsics()
    rows = np.unique(np.linspace(0, len(labels) - 1, n_sampled).astype(int))
    sample = labels.iloc[rows].assign(row=rows).merge(tables["frames"], on="frame_id")
    sample = sample.merge(tables["craters"], on=["scene_id", "crater_id"])
    for _, group in sample.groupby("frame_id"):
        rotation = matrix_from_quaternion(group["rotation_wxyz"].iloc[0])
        centres = camera_from_site(group[["x_m", "y_m", "z_m"]].to_numpy(), group["position_m"].iloc[0], rotation)
        normals = group[["normal_x", "normal_y", "normal_z"]].to_numpy() @ rotation.T
        ellipses = project_circles(camera, centres, normals, group["diameter_m"].to_numpy() / 2)
        again = np.stack([ellipses.cx_px, ellipses.cy_px, ellipses.a_px, ellipses.b_px], axis=1)
        again = np.concatenate([again, ellipses.bounding_boxes()], axis=1)
        names = [
            "ellipse_cx_px",
            "ellipse_cy_px",
            "ellipse_a_px",
            "ellipse_b_px",
            "bbox_x0_px",
            "bbox_y0_px",
            "bbox_x1_px",
            "bbox_y1_px",
        ]
        apart = ~(np.abs(again - group[names].to_numpy()) < _LABEL_TOLERANCE_PX * (1 + ellipses.a_px[:, None]))
        if apart.any():
            row, column = np.argwhere(apart)[0]
            yield Fault(
                "manifest/labels",
                int(group["row"].iloc[row]),
                names[column],
                str(group[names[column]].iloc[row]),
                f"{again[row, column]}, projected from crater and pose",
            )


def _files(dataset: Dataset, frames: pd.DataFrame, progress: Progress | None) -> Iterator[Fault]:
    """Presence, size and hash of every frame's files."""
    task = progress.add_task("hashing", total=len(frames), unit="frames", note="") if progress else None
    for row, frame in enumerate(frames.to_dict("records")):
        for kind in ("png", "exr"):
            relative = frame[f"{kind}_path"]
            if kind == "exr" and not isinstance(relative, str):
                continue
            try:
                path = dataset.file(relative)
            except UserError as error:
                yield Fault("manifest/frames", row, f"{kind}_path", str(error), "a path inside the dataset")
                continue
            if not path.is_file():
                yield Fault(relative, row, f"{kind}_path", "no such file", "the frame")
            elif path.stat().st_size != frame[f"{kind}_bytes"]:
                yield Fault(relative, row, f"{kind}_bytes", str(path.stat().st_size), str(frame[f"{kind}_bytes"]))
            elif files.sha256_of(path) != frame[f"{kind}_sha256"]:
                yield Fault(relative, row, f"{kind}_sha256", "another content", frame[f"{kind}_sha256"])
        if progress is not None and task is not None:
            progress.advance(task)
