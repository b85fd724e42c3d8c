"""Check a whole dataset and return its faults: file, row, column, value found and value expected.

Tables are read part by part, then trajectory by trajectory, so memory does not grow with the dataset.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import PurePosixPath

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.content import content_sha256, terrain_of
from perilune_shared.dataset.manifest import Dataset, count_rows
from perilune_shared.dataset.names import SCENE_FILE_KINDS, is_whole
from perilune_shared.dataset.schema import KEYS, OPTIONAL_TABLES, TABLES
from perilune_shared.errors import UserError
from perilune_shared.geometry.frames import selenographic_from_site
from perilune_shared.validation.cameras import camera_faults
from perilune_shared.validation.faults import Fault, FaultList, part_faults
from perilune_shared.validation.files import file_faults
from perilune_shared.validation.images import image_faults
from perilune_shared.validation.shards import shard_faults
from perilune_shared.validation.trajectory import TrajectoryRows, measurement_faults, trajectory_faults

_TOLERANCE_DEG = 1e-9
_EMPTY_IN_PLANS = ("craters", "boulders", "labels", *OPTIONAL_TABLES)


def validate(dataset: Dataset, progress: Progress = NO_PROGRESS) -> list[Fault]:
    """Return the faults of a dataset; an empty list means that all checks passed.

    Faults of one file and column are reported once, with the first row. Every file is read, and all labels are compared
    with ellipses projected from crater and pose.
    """
    # Values that overflow are reported as faults; NumPy's warnings would clutter the output.
    with np.errstate(all="ignore"), dataset.parts_kept_open():
        return _faults(dataset, progress)


def _faults(dataset: Dataset, progress: Progress) -> list[Fault]:
    faults = FaultList()
    faults.extend(file_faults(dataset, progress))
    if not dataset.info.complete:
        expected = "a finished dataset; run `make dataset` again to resume"
        faults.add(Fault.of("dataset.json", None, "complete", "False", expected))
    for name in TABLES:
        for part in dataset.parts(name):
            faults.extend(part_faults(dataset, part, name))
    try:
        faults.extend(_table_faults(dataset, progress))
    except UserError as error:
        if not len(faults):
            faults.add(Fault.from_error("manifest", None, error))
    try:
        if dataset.info.images == "files":
            faults.extend(image_faults(dataset, progress))
        elif dataset.info.images == "packed":
            faults.extend(shard_faults(dataset, progress))
    except UserError as error:
        if not len(faults):
            faults.add(Fault.from_error("images", None, error))
    return faults.faults()


def _table_faults(dataset: Dataset, progress: Progress) -> Iterator[Fault]:
    """Check the rows of different tables against each other."""
    counts = count_rows(dataset).model_dump()
    for name, present in counts.items():
        counted = getattr(dataset.info.counts, name)
        if counted != present:
            yield Fault.of("dataset.json", None, f"counts.{name}", counted, f"{present}, the number of rows")
        if dataset.info.images == "planned" and name in _EMPTY_IN_PLANS and present:
            yield Fault.of(
                f"manifest/{name}", None, "images", "rows", "no rows, since images is planned in dataset.json"
            )
    scene_ids = dataset.table("scenes", ["scene_id"])["scene_id"].to_pylist()
    yield from _repeated_keys(dataset, "scenes", dataset.table("scenes", KEYS["scenes"]), "manifest/scenes")
    used: set[str] = set()
    reported: set[tuple[str, str]] = set()
    seen = dict.fromkeys(TABLES, 0)
    splits_of_terrain: dict[str, set[str]] = defaultdict(set)
    splits_of_trajectory: dict[tuple[str, object], set[str]] = defaultdict(set)
    task = progress.add_task("checking", total=len(scene_ids), unit="scenes")
    for scene_id in dict.fromkeys(scene_ids):
        scene = dataset.table("scenes", scene_id=scene_id)
        if not len(scene):
            expected = "part names and statistics that match the rows of the scene"
            yield Fault.of(
                "manifest/scenes", None, "part", f"rows of {scene_id} in another part or row group", expected
            )
            continue
        used.add(scene["recipe"][0].as_py())
        frame_splits = dataset.table("frames", ["trajectory_id", "split"], scene_id=scene_id)
        row = scene.to_pylist()[0]
        terrain = terrain_of(row["dem_source"], row["content_sha256"])
        splits_of_terrain[terrain] |= set(frame_splits["split"].unique().to_pylist())
        seeds = dataset.table("trajectories", ["trajectory_id", "seed"], scene_id=scene_id).to_pydict()
        seed_of = dict(zip(seeds["trajectory_id"], seeds["seed"], strict=True))
        for trajectory_id, split in {tuple(each.values()) for each in frame_splits.to_pylist()}:
            splits_of_trajectory[terrain, seed_of.get(trajectory_id, trajectory_id)].add(split)
        seen["scenes"] += len(scene)
        yield from _scene_faults(dataset, scene_id, scene, seen, reported)
        progress.advance(task)
    for name, present in counts.items():
        if seen[name] != present:
            expected = f"{seen[name]}: the rows of the listed scenes and trajectories"
            yield Fault.of(f"manifest/{name}", None, "+".join(KEYS[name][:1]), f"{present} rows", expected)
    if used != set(dataset.info.recipes):
        yield Fault.of(
            "dataset.json", None, "recipes", sorted(dataset.info.recipes), f"{sorted(used)}, the recipes of the scenes"
        )
    for terrain, splits in splits_of_terrain.items():
        if len(splits) > 1 and dataset.info.split_by == "scene":
            found = f"terrain {terrain[:12]} in {' and '.join(sorted(map(str, splits)))}"
            yield Fault.of("manifest/frames", None, "split", found, "one split for each terrain (split_by is scene)")
    for (terrain, _), splits in splits_of_trajectory.items():
        if len(splits) > 1 and dataset.info.split_by != "frame":
            found = f"a trajectory over terrain {terrain[:12]} in {' and '.join(sorted(map(str, splits)))}"
            yield Fault.of(
                "manifest/frames",
                None,
                "split",
                found,
                "one split for each trajectory, also for copies under another name",
            )


def _scene_faults(
    dataset: Dataset, scene_id: str, scene: pa.Table, seen: dict[str, int], reported: set[tuple[str, str]]
) -> Iterator[Fault]:
    """Check a scene's row, craters, boulders and trajectories; add the numbers of rows to `seen`."""
    where = {name: _file_of(dataset, name, scene_id) for name in TABLES}
    craters = dataset.table("craters", scene_id=scene_id)
    boulders = dataset.table("boulders", scene_id=scene_id)
    trajectories = dataset.table("trajectories", scene_id=scene_id)
    for name, rows in (("craters", craters), ("boulders", boulders), ("trajectories", trajectories)):
        seen[name] += len(rows)
        yield from _repeated_keys(dataset, name, rows.select(KEYS[name]), where[name])
    row = scene.to_pylist()[0]
    for kind in SCENE_FILE_KINDS:
        if len({row[f"{kind}_{name}"] is None for name in ("sha256", "bytes")}) > 1 or (
            row[f"{kind}_sha256"] is not None and row[f"{kind}_path"] is None
        ):
            yield Fault.of(where["scenes"], 0, f"{kind}_sha256", "null", "path, hash and size together")
    if dataset.info.images != "planned":
        content = content_sha256(craters, boulders)
        if row["content_sha256"] != content:
            yield Fault.of(
                where["scenes"],
                0,
                "content_sha256",
                row["content_sha256"],
                f"{content}, the hash of craters and boulders",
            )
    if len(craters):
        yield from _in_file(dataset, _crater_faults(craters, row, where["craters"]), scene_id, reported)
    if dataset.info.cameras is not None:
        yield from camera_faults(dataset, scene_id, where["frames"])
    for trajectory in trajectories.to_pylist():
        trajectory_id = trajectory["trajectory_id"]
        frames = dataset.table("frames", scene_id=scene_id, trajectory_id=trajectory_id)
        labels = dataset.table("labels", scene_id=scene_id, trajectory_id=trajectory_id)
        seen["frames"] += len(frames)
        seen["labels"] += len(labels)
        files = {name: _file_of(dataset, name, scene_id, trajectory_id) for name in ("frames", "labels")}
        for name, rows in (("frames", frames), ("labels", labels)):
            yield from _repeated_keys(dataset, name, rows.select(KEYS[name]), files[name])
        of_trajectory = TrajectoryRows(row, craters, trajectory, frames, labels, files)
        faults = trajectory_faults(dataset.info, of_trajectory)
        yield from _in_file(dataset, faults, f"{scene_id}/{trajectory_id}/", reported)
        for name in OPTIONAL_TABLES:
            rows = dataset.table(name, scene_id=scene_id, trajectory_id=trajectory_id)
            seen[name] += len(rows)
            if len(rows):
                yield from measurement_faults(name, rows, trajectory)


def _in_file(dataset: Dataset, faults: Iterator[Fault], name: str, reported: set[tuple[str, str]]) -> Iterator[Fault]:
    """Convert row numbers of faults within a scene or trajectory to row numbers of the file.

    `name` is the scene_id, or the beginning of the trajectory's frame_ids. Only the first fault of a file and column is
    yielded; `reported` has the pairs of file and column that have been reported.
    """
    for fault in faults:
        if (fault.file, fault.column) in reported:
            continue
        reported.add((fault.file, fault.column))
        if fault.row is not None and is_whole(PurePosixPath(fault.file).stem):
            part = dataset.open_part(fault.file, PurePosixPath(fault.file).parent.name)
            key = "frame_id" if "frame_id" in part.schema.names else "scene_id"
            keys = part.read([key])[key]
            of_key = pc.starts_with(keys, name) if key == "frame_id" else pc.equal(keys, name)
            fault = replace(fault, row=int(np.flatnonzero(of_key)[fault.row]))
        yield fault


def _crater_faults(craters: pa.Table, scene: dict, where: str) -> Iterator[Fault]:
    """Check that latitude and longitude match x and y, and that normals have length 1."""
    normals = np.stack([craters[f"normal_{axis}"].to_numpy() for axis in "xyz"], axis=1)
    wrong = np.flatnonzero(np.abs(np.linalg.norm(normals, axis=1) - 1) > 1e-6)
    if len(wrong):
        yield Fault.of(where, int(wrong[0]), "normal_x", normals[wrong[0]].tolist(), "a normal of length 1")
    x, y = craters["x_m"].to_numpy(), craters["y_m"].to_numpy()
    latitude, longitude = selenographic_from_site(x, y, scene["latitude_deg"], scene["longitude_deg"])
    for name, computed in (("latitude_deg", latitude), ("longitude_deg", longitude)):
        error_deg = np.abs(craters[name].to_numpy() - computed)
        error_deg = np.minimum(error_deg, np.abs(error_deg - 360))
        wrong = np.flatnonzero(error_deg > _TOLERANCE_DEG)
        if len(wrong):
            found = craters[name][int(wrong[0])].as_py()
            yield Fault.of(where, int(wrong[0]), name, found, f"{computed[wrong[0]]}, from x_m and y_m")


def _file_of(dataset: Dataset, table: str, scene_id: str, trajectory_id: str | None = None) -> str:
    parts = dataset.parts(table, scene_id, trajectory_id)
    return parts[0] if len(parts) == 1 else f"manifest/{table}"


def _repeated_keys(dataset: Dataset, table: str, keys: pa.Table, where: str) -> Iterator[Fault]:
    counted = keys.group_by(keys.column_names).aggregate([([], "count_all")])
    repeated = counted.filter(pc.greater(counted["count_all"], 1))
    if len(repeated):
        found = list(repeated.to_pylist()[0].values())[:-1]
        yield Fault.of(where, None, "+".join(KEYS[table]), found, "unique")
