"""Measure the detectability of the labels of a dataset's frames, batch by batch of removed craters."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from perilune_render.config.dataset import DatasetConfig
from perilune_render.dataset.shots import planned_shot
from perilune_render.dataset.tables import ground_tables
from perilune_render.detectability.observer import Observation, observe
from perilune_render.detectability.removals import removal_batches
from perilune_render.detectability.signals import ExpectedFrame, RemovalRenderer
from perilune_render.flight.plan import Plan, ScenePlan
from perilune_render.terrain.cache import cached_scene
from perilune_render.terrain.scene import Scene
from perilune_render.terrain.unstamped import Unstamped
from perilune_shared.console.interrupts import interrupts_held
from perilune_shared.console.progress import NO_PROGRESS, Progress
from perilune_shared.content import content_sha256
from perilune_shared.dataset.frame import ELLIPSE_COLUMNS
from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.geometry.ellipse import Ellipses
from perilune_shared.labels.selection import read_labels
from perilune_shared.storage.files import write_bytes, written_aside

WORK_RECORD = "work.json"
"""File in the folder of parts that says of which measurement the parts are."""
VERSION = 1
"""Version of the observer; parts of another version are not resumed."""
SCHEMA = pa.schema(
    [("frame_id", pa.string()), ("crater_id", pa.int64())]
    + [(field.name, pa.float32()) for field in fields(Observation)]
)
"""Columns of the table of detectabilities."""


@dataclass(frozen=True, slots=True)
class Labels:
    """The labels of generated craters in the frames of a plan, and the craters of the dataset's scenes."""

    rows: pd.DataFrame
    """Columns frame_id, scene_id, crater_id, radius_px and the ellipse; the index is 0, 1, ..."""
    dataset: Dataset
    """The dataset of the labels."""


def labels_of(dataset: Dataset, plan: Plan, split: str) -> Labels:
    """The labels in the frames of a plan, without those of craters that an elevation model shows.

    Raises UserError if there are no labels, or if an ellipse is not finite.
    """
    rows = read_labels(dataset, list(ELLIPSE_COLUMNS), split)
    planned = {each.frame_id(k) for each in plan.trajectories for k in range(len(each.splits))}
    rows = rows[rows["frame_id"].isin(planned)]
    craters = dataset.table("craters", ["scene_id", "crater_id", "origin"]).to_pandas()
    rows = rows.merge(craters, on=["scene_id", "crater_id"], how="left")
    rows = rows[rows["origin"] != "elevation model"].reset_index(drop=True)
    if not len(rows):
        raise UserError(dataset.store, "labels", f"no labels of generated craters in {split}", "a rendered dataset")
    shape = rows[["radius_px", *ELLIPSE_COLUMNS]].to_numpy(np.float64)
    wrong = ~np.isfinite(shape).all(axis=1) | (shape[:, 0] <= 0) | (shape[:, 3:5] <= 0).any(axis=1)
    if wrong.any():
        first = rows.iloc[int(wrong.argmax())]
        where = f"{first['crater_id']} in {first['frame_id']}"
        raise UserError(dataset.store, "labels: ellipse", where, "finite numbers and axes above 0")
    return Labels(rows, dataset)


def measure(
    labels: Labels, plan: Plan, config: DatasetConfig, parts: Path, progress: Progress = NO_PROGRESS
) -> pa.Table:
    """The detectability of all `labels`, with the columns of SCHEMA, sorted by frame and crater.

    Finished batches are stored in the folder `parts`, and a later call with the same arguments uses them. Raises
    UserError if the folder holds parts of other arguments, or if the ground is not the ground of the dataset.
    """
    work_record = _checked_record(parts, labels, plan)
    task = progress.add_task("detectability", total=len(labels.rows), unit="labels")
    tables = []
    for number, scene in enumerate(plan.scenes):
        rows = labels.rows[labels.rows["scene_id"] == scene.scene_id]
        if not len(rows):
            continue
        progress.update(task, note=f"{scene.scene_id}: generating ground")
        with interrupts_held():
            ground = cached_scene(config, plan.view, scene.seed)
        _check_ground(labels.dataset, scene, ground)
        ids = np.unique(rows["crater_id"].to_numpy())
        if ids[0] < 0 or ids[-1] >= len(ground.craters):
            raise UserError(labels.dataset.store, "labels: crater_id", ids[-1], f"craters of {scene.scene_id}")
        batches = [ids[batch] for batch in removal_batches(ground.craters.chosen(ids))]
        work = _SceneWork(ground, plan, config, scene, ids)
        for k, batch in enumerate(batches):
            path = parts / f"{number:05d}-{k:05d}.parquet"
            taken = rows[rows["crater_id"].isin(batch)]
            if not path.exists():
                progress.update(task, note=f"{scene.scene_id}: batch {k + 1} of {len(batches)}")
                # Create the folder only now, so that refused input leaves none.
                write_bytes(parts / WORK_RECORD, work_record)
                with written_aside(path) as aside:
                    pq.write_table(work.measured(batch, taken), aside)
            tables.append(_read_part(path, len(taken)))
            progress.advance(task, len(taken))
    return pa.concat_tables(tables).sort_by([("frame_id", "ascending"), ("crater_id", "ascending")])


class _SceneWork:
    """Renders and observes the batches of one scene; renders frames when the first batch needs them."""

    def __init__(self, ground: Scene, plan: Plan, config: DatasetConfig, scene: ScenePlan, ids: np.ndarray):
        self._ground, self._plan, self._config, self._scene, self._ids = ground, plan, config, scene, ids
        self._unstamped: Unstamped | None = None
        self._renderers: dict[str | None, RemovalRenderer] = {}
        self._frames: dict[str, ExpectedFrame] = {}
        self._camera_of: dict[str, str | None] = {}

    def measured(self, batch: np.ndarray, rows: pd.DataFrame) -> pa.Table:
        """The rows of the table for the labels `rows` of a batch of craters."""
        if self._unstamped is None:
            self._unstamped = Unstamped(self._ground, self._config, self._plan.view, self._ids)
            self._render_frames()
        without = self._unstamped.without(batch)
        found: list[tuple] = []
        for camera, renderer in self._renderers.items():
            of_camera = rows[rows["frame_id"].map(self._camera_of).isin([camera])]
            parts = [(str(name), part) for name, part in of_camera.groupby("frame_id")]
            items = [(self._frames[name], part["crater_id"].to_numpy(), _ellipses(part)) for name, part in parts]
            for (name, _), (frame, _, _), removals in zip(parts, items, renderer.without(without, items), strict=True):
                for each in removals:
                    noise = frame.noise[each.rows, each.columns]
                    signal, background = each.signal(frame.mean), each.background(frame.mean)
                    seen = observe(signal, background, noise, each.centre_px, each.axes_px)
                    found.append((name, each.crater_id, *astuple(seen)))
        columns = list(zip(*found, strict=True)) if found else [()] * len(SCHEMA)
        return pa.table([pa.array(c, kind) for c, kind in zip(columns, SCHEMA.types, strict=True)], schema=SCHEMA)

    def _render_frames(self) -> None:
        for trajectory in self._plan.of_scene(self._scene.scene_id):
            mounted = self._plan.rig[trajectory.camera]
            if trajectory.camera not in self._renderers:
                cameras = mounted.camera, mounted.exr_camera
                self._renderers[trajectory.camera] = RemovalRenderer(
                    self._ground, self._config, cameras, self._scene.sun
                )
            renderer = self._renderers[trajectory.camera]
            for k in range(len(trajectory.splits)):
                name = trajectory.frame_id(k)
                self._frames[name] = renderer.frame(planned_shot(trajectory, k))
                self._camera_of[name] = trajectory.camera


def _ellipses(rows: pd.DataFrame) -> Ellipses:
    return Ellipses(*(rows[name].to_numpy(np.float64) for name in ELLIPSE_COLUMNS))


def _check_ground(dataset: Dataset, scene: ScenePlan, ground: Scene) -> None:
    """Raise UserError if the generated ground is not the ground of the dataset."""
    recorded = dataset.table("scenes", ["content_sha256"], scene_id=scene.scene_id)["content_sha256"][0].as_py()
    tables = ground_tables(scene.scene_id, ground)
    found = content_sha256(tables["craters"], tables["boulders"])
    if found != recorded:
        expected = f"{recorded}, the terrain hash in the dataset; use the version of perilune that rendered it"
        raise UserError(dataset.store, f"content_sha256 of {scene.scene_id}", found, expected)


def _checked_record(parts: Path, labels: Labels, plan: Plan) -> bytes:
    """The record of this work. Raises UserError if the folder `parts` has the record of other work."""
    digest = hashlib.sha256(pd.util.hash_pandas_object(labels.rows[["frame_id", "crater_id"]]).to_numpy().tobytes())
    work = {
        "version": VERSION,
        "dataset": labels.dataset.store.sha256("dataset.json"),
        "labels": digest.hexdigest(),
        "scenes": [scene.seed for scene in plan.scenes],
    }
    content = json.dumps(work).encode()
    path = parts / WORK_RECORD
    if path.exists() and path.read_bytes() != content:
        expected = "parts of this dataset, split and version; delete this folder, or choose another --out"
        raise UserError(parts, "parts", "parts of another measurement", expected)
    return content


def _read_part(path: Path, n_rows: int) -> pa.Table:
    """A finished batch. Raises UserError if the file is damaged."""
    try:
        table = pq.read_table(path, schema=SCHEMA)
    except (OSError, pa.ArrowException):
        table = None
    if table is None or len(table) != n_rows:
        raise UserError(path, "rows", "a damaged file", "a part of this measurement; delete it and run again")
    return table


def parts_of(parts: Path) -> Iterator[Path]:
    """The files that `measure` writes into a folder."""
    yield from sorted(parts.glob("[0-9]*-[0-9]*.parquet"))
    yield parts / WORK_RECORD
