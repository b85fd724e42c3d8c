"""Select part of a dataset by conditions on columns, by number of frames or by size."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.dataset.expression import Condition, columns_of
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.names import ImageMode
from perilune_shared.editing.rewrite import Rewriting, check_source, rewrite
from perilune_shared.editing.writer import SceneTables
from perilune_shared.errors import UserError
from perilune_shared.storage.store import Address


@dataclass(frozen=True, slots=True)
class Limit:
    """Maximum size of a subset."""

    n_frames: int | None = None
    """Maximum number of frames; None sets no limit."""
    megabytes: float | None = None
    """Maximum total size of the PNGs, 10^6 bytes; None sets no limit."""


def subset(
    source: Dataset,
    out: Address,
    where: Sequence[str] = (),
    limit: Limit | None = None,
    images: ImageMode = "copy",
    progress: Progress = NO_PROGRESS,
) -> None:
    """Write the frames and labels that fulfil all conditions, up to a limit.

    A condition that uses only columns of frames, trajectories and scenes selects frames. A condition that uses labels
    or craters selects labels and keeps all frames. Scenes keep all craters and boulders, since these identify the
    terrain. Up to `limit`, trajectories are taken from each scene in turn, so that the subset has many terrains; the
    last trajectory may be truncated. Raises UserError if no frame fulfils the conditions.
    """
    conditions = [Condition(text) for text in where]
    on_frames = [condition for condition in conditions if not condition.on_labels]
    on_labels = [condition for condition in conditions if condition.on_labels]
    planned = source.info.images == "planned" or images == "plan"
    if on_labels and planned:
        expected = "conditions on frames, trajectories and scenes: a plan has no labels"
        raise UserError("--where", "", on_labels[0].text, expected)
    check_source(source, out, progress)
    frames_within_limit = None if limit is None else _first_frames(source, on_frames, limit)

    def change(tables: SceneTables) -> SceneTables:
        frames = tables["frames"]
        mask = _all_hold(on_frames, tables, frames)
        if frames_within_limit is not None:
            mask = mask & np.asarray(pc.is_in(frames["frame_id"], frames_within_limit), bool)
        labels = tables["labels"].filter(pa.array(_all_hold(on_labels, tables, tables["labels"])))
        return {**tables, "frames": frames.filter(pa.array(mask)), "labels": labels}

    steps = [*(f"where {text}" for text in where)]
    if limit is not None:
        steps += [f"{limit.n_frames} frames"] if limit.n_frames is not None else []
        steps += [f"{limit.megabytes:g} MB"] if limit.megabytes is not None else []
    steps += ["no craters and labels"] if images == "plan" else []
    info = source.info.changed("subset: " + ("; ".join(steps) or "all").replace("<", " lt ").replace(">", " gt "))
    rewrite(source, out, Rewriting(info, change, images, _scenes_with(source, on_frames)), progress)


def _scenes_with(source: Dataset, on_frames: Sequence[Condition]) -> list[str]:
    """Return the scenes that may contain a selected frame, so that other scenes need not be read."""
    scene_ids = set(source.scene_ids())
    for condition in on_frames:
        names = condition.columns_of_only("frames")
        if names is not None:
            # Dataset.table with `where` would skip row groups by statistics that `check_keys` does not check.
            rows = source.table("frames", list(dict.fromkeys(["scene_id", *names])))
            chosen = condition.holds(rows.rename_columns([f"frames.{name}" for name in rows.column_names]))
            scene_ids &= set(rows["scene_id"].filter(pa.array(chosen)).unique().to_pylist())
    return sorted(scene_ids)


def _first_frames(source: Dataset, on_frames: Sequence[Condition], limit: Limit) -> pa.Array:
    """Return frame_ids up to the limit, taking trajectories from each scene in turn."""
    n_frames, megabytes = limit.n_frames, limit.megabytes
    if (n_frames is not None and n_frames < 1) or (megabytes is not None and not megabytes > 0):
        raise UserError("--frames or --mb", "size", n_frames if n_frames is not None else megabytes, "above 0")
    pieces = []
    for scene_id in source.scene_ids():
        tables = {name: source.table(name, scene_id=scene_id) for name in ("scenes", "trajectories", "frames")}
        frames = tables["frames"].filter(pa.array(_all_hold(on_frames, tables, tables["frames"])))
        pieces.append(frames.select(["frame_id", "scene_id", "trajectory_id", "frame_index", "png_bytes"]).to_pandas())
    if not pieces:
        raise UserError(source.store, "scenes", "none", "a dataset with frames")
    table = pd.concat(pieces, ignore_index=True)
    if megabytes is not None and table["png_bytes"].isna().any():
        raise UserError(source.store, "png_bytes", "null", "--frames instead: unrendered frames have no size")
    table["turn"] = table.groupby("scene_id")["trajectory_id"].transform(lambda ids: pd.factorize(ids, sort=True)[0])
    table = table.sort_values(["turn", "scene_id", "frame_index"], ignore_index=True)
    if n_frames is not None:
        table = table.iloc[:n_frames]
    if megabytes is not None:
        table = table[table["png_bytes"].cumsum() <= megabytes * 1e6]
    return pa.array(table["frame_id"], pa.string())


def _all_hold(conditions: Sequence[Condition], tables: SceneTables, rows: pa.Table) -> np.ndarray:
    """Return for each row (N,) of a scene's frames or labels whether it fulfils all conditions."""
    mask = np.ones(len(rows), bool)
    if not conditions or not len(rows):
        return mask
    columns = {f"{table}.{name}": _column(tables, rows, table, name) for table, name in columns_of(conditions)}
    joined = pa.table(columns)
    for condition in conditions:
        mask &= condition.holds(joined)
    return mask


def _column(tables: SceneTables, rows: pa.Table, table: str, name: str) -> pa.ChunkedArray:
    """Return a column of any table of a scene, with one value for each of `rows` (frames or labels)."""
    values = tables[table][name]
    if table == "scenes":
        return values.take(np.zeros(len(rows), np.int64))
    on_labels = "crater_id" in rows.column_names
    if table == "labels":
        return rows[name]
    if table == "craters":
        return values.take(_row_numbers(rows["crater_id"], tables["craters"]["crater_id"]))
    frames = tables["frames"]
    of_frame = _row_numbers(rows["frame_id"], frames["frame_id"]) if on_labels else np.arange(len(rows))
    if table == "frames":
        return (values if on_labels else rows[name]).take(of_frame)
    of_trajectory = _row_numbers(frames["trajectory_id"], tables["trajectories"]["trajectory_id"])
    return values.take(of_trajectory[of_frame])


def _row_numbers(values: pa.ChunkedArray, within: pa.ChunkedArray) -> np.ndarray:
    index = pd.Index(within.to_pandas())
    return index.get_indexer(values.to_pandas())
