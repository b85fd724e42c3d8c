"""Write a new dataset atomically, scene by scene, for all editing commands.

The writer recomputes from the rows: the number of rows of each table, the number of frames and the split of each
trajectory, and `split_by` in dataset.json.
"""

import contextlib
import json
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.content import terrain_of
from perilune_shared.dataset.index import frame_rows, index_rows, scene_file_rows, seal
from perilune_shared.dataset.info_file import INFO_NAME, checked_info, info_bytes
from perilune_shared.dataset.label_rows import with_frame_columns
from perilune_shared.dataset.manifest import LARGEST_FRAME_BYTES, Dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.names import IMAGE_KINDS, SCENE_FILE_KINDS, SplitUnit, frame_path, scene_file_path
from perilune_shared.dataset.parts import MAX_ROWS_WRITTEN, WrittenFile
from perilune_shared.dataset.schema import OPTIONAL_TABLES
from perilune_shared.dataset.whole_tables import WholeTables
from perilune_shared.errors import UserError
from perilune_shared.storage import files
from perilune_shared.storage.new_store import new_store
from perilune_shared.storage.store import Address, Store

SceneTables = dict[str, pa.Table]
"""All tables of one scene, by name."""
_PER_TRAJECTORY = ("frames", "labels")


class DatasetWriter:
    """Writer of a new dataset. Create it with `new_dataset`."""

    def __init__(self, store: Store, info: DatasetInfo, *, max_rows: int = MAX_ROWS_WRITTEN):
        self.store, self.info = store, info
        self._tables = WholeTables(store, max_rows=max_rows)
        self._index: list[pa.Table] = []
        self._splits_of_terrain: dict[str, set[str]] = defaultdict(set)
        self._splits_of_trajectory: dict[tuple[str, int], set[str]] = defaultdict(set)
        self._has_exr = False
        self._cameras: set[str] = set()
        self._recipes: set[str] = set()

    def add_scene(self, tables: SceneTables) -> None:
        """Append one scene that has frames.

        Recomputes the number of frames and the split of each trajectory, and sets the paths at which `add_images`
        stores the frames. Raises UserError unless there is exactly one scene and the trajectory of each frame exists.
        """
        check_scene("new dataset", tables)
        frames = with_new_paths(tables["frames"])
        splits = frames["split"].to_numpy(zero_copy_only=False)
        scene = tables["scenes"].to_pylist()[0]
        terrain = terrain_of(scene["dem_source"], scene["content_sha256"])
        self._splits_of_terrain[terrain] |= set(splits)
        for trajectory in tables["trajectories"].select(["trajectory_id", "seed"]).to_pylist():
            of_trajectory = np.asarray(pc.equal(frames["trajectory_id"], trajectory["trajectory_id"]), bool)
            self._splits_of_trajectory[terrain, trajectory["seed"]] |= set(splits[of_trajectory])
        self._has_exr |= frames["exr_path"].null_count < len(frames)
        self._cameras |= set(frames["camera"].drop_null().unique().to_pylist())
        self._recipes |= set(tables["scenes"]["recipe"].to_pylist())
        trajectories = _with_counts_and_splits(tables["trajectories"], frames)
        labels = with_frame_columns(tables["labels"], frames)
        scenes = _with_new_scene_paths(tables["scenes"])
        tables = {**tables, "scenes": scenes, "frames": frames, "trajectories": trajectories, "labels": labels}
        for name in OPTIONAL_TABLES:
            if name in tables:
                tables[name] = of_trajectories(tables[name], trajectories)
        if self.info.images == "files":
            self._index += [frame_rows(frames), scene_file_rows(scenes)]
        for name, rows in tables.items():
            self._tables.add(name, _sorted_by(rows, "frame_id") if name in _PER_TRAJECTORY else rows)

    def add_images(self, source: Dataset, frames: pa.Table, names: dict[str, str], *, link: bool) -> None:
        """Write images of `source` as files: `frames` are its rows, `names` maps old to new frame_ids.

        With `link`, make hard links where the file system allows it.
        """
        by_id = {row["frame_id"]: row for row in frames.select(["frame_id", "exr_path", "lidar_path"]).to_pylist()}
        if source.info.images == "packed":
            for frame_id, png in source.pngs(frames):
                self.store.write(frame_path(names[frame_id], "png"), png, durable=False)
        else:
            for row in frames.select(["frame_id", "png_path"]).to_pylist():
                by_id[row["frame_id"]]["png_path"] = row["png_path"]
        for frame_id, row in by_id.items():
            for kind in IMAGE_KINDS:
                if row.get(f"{kind}_path") is not None:
                    self._copy(source, row[f"{kind}_path"], frame_path(names[frame_id], kind), link=link)

    def add_scene_files(self, source: Dataset, scenes: pa.Table, scene_id: str, *, link: bool) -> None:
        """Copy a scene's files (hazard map): `scenes` is its row in `source`, `scene_id` its new id."""
        for kind in SCENE_FILE_KINDS:
            path = scenes[f"{kind}_path"][0].as_py()
            if path is not None:
                self._copy(source, path, scene_file_path(scene_id, kind), link=link)

    def _copy(self, source: Dataset, path: str, to: str, *, link: bool) -> None:
        if source.store.is_local and self.store.folder is not None:
            files.copy_or_link(source.file(path), files.inside(self.store.folder, to), link=link)
        else:
            self.store.write(to, source.store.read(path, most_bytes=LARGEST_FRAME_BYTES), durable=False)

    def add_file(self, path: str, content: bytes) -> None:
        """Write a file that is neither a table nor an image, such as a shard."""
        self.store.write(path, content, durable=False)
        self._index.append(index_rows([WrittenFile.of(path, content)]))

    def finish(self, out: Address) -> None:
        """Write buffered rows, the index, then dataset.json. Raises UserError if there are no frames."""
        counts = self._tables.counts
        if not counts.frames:
            raise UserError(out, "frames", "none left", "conditions that select at least one frame")
        self._index.append(index_rows(self._tables.finish()))
        # Trajectories with equal seeds over one terrain are one flight, e.g. developed again with another sensor.
        trajectory_in_two_splits = any(len(splits) > 1 for splits in self._splits_of_trajectory.values())
        terrain_in_two_splits = any(len(splits) > 1 for splits in self._splits_of_terrain.values())
        unit: SplitUnit = "frame" if trajectory_in_two_splits else "trajectory" if terrain_in_two_splits else "scene"
        exr = {} if self._has_exr else {"exr_camera": None, "exr_cameras": None}
        recipes = {key: recipe for key, recipe in self.info.recipes.items() if key in self._recipes}
        info = self.info.with_cameras(self._cameras)
        info = info.model_copy(update={"split_by": unit, "recipes": recipes, "counts": counts, **exr})
        seal(self.store, info, pa.concat_tables(self._index))


@contextlib.contextmanager
def new_dataset(
    out: Address,
    info: DatasetInfo,
    *,
    max_rows: int = MAX_ROWS_WRITTEN,
) -> Iterator[DatasetWriter]:
    """Yield a writer for a new dataset. The dataset appears at `out` only if the block succeeds.

    Each table becomes one part, or several parts of at most `max_rows` rows. `info` provides the metadata that is not
    computed from the rows. Raises UserError if there are no frames or `out` is not empty.
    """
    # Pydantic does not validate copies with replaced fields.
    checked_info(json.loads(info.model_dump_json()), out)
    claim = info_bytes(info.model_copy(update={"complete": False, "index": ()}), out)
    with new_store(out, INFO_NAME, claim) as store:
        writer = DatasetWriter(store, info, max_rows=max_rows)
        yield writer
        writer.finish(out)


def check_scene(where: object, tables: SceneTables) -> None:
    """Raise UserError unless there is exactly one scene and the trajectory of each frame exists."""
    scenes, frames = tables["scenes"]["scene_id"], tables["frames"]
    if len(scenes) != 1:
        found = f"{len(scenes)} rows of {min(scenes.to_pylist(), default='a scene')}"
        raise UserError(where, "scenes", found, "one row for the scene; see `perilune-manifest validate`")
    missing = set(frames["trajectory_id"].to_pylist()) - set(tables["trajectories"]["trajectory_id"].to_pylist())
    if missing:
        found = f"no {scenes[0].as_py()}/{min(missing)}"
        raise UserError(where, "trajectories", found, "the trajectory of every frame; see `perilune-manifest validate`")


def with_column(table: pa.Table, name: str, values: object) -> pa.Table:
    """Return a table with one column replaced."""
    index = table.schema.get_field_index(name)
    field = table.schema.field(index)
    array = values if isinstance(values, pa.Array | pa.ChunkedArray) else pa.array(values, field.type)
    return table.set_column(index, field, array)


def with_new_paths(frames: pa.Table) -> pa.Table:
    """Return frames with the file paths of a new dataset; a source dataset may have other paths."""
    ids = frames["frame_id"].to_pylist()
    for kind in IMAGE_KINDS:
        name = f"{kind}_path"
        known = frames[name].to_pylist()
        paths = [None if path is None else frame_path(key, kind) for key, path in zip(ids, known, strict=True)]
        frames = with_column(frames, name, paths)
    return frames


def _with_new_scene_paths(scenes: pa.Table) -> pa.Table:
    ids = scenes["scene_id"].to_pylist()
    for kind in SCENE_FILE_KINDS:
        known = scenes[f"{kind}_path"].to_pylist()
        paths = [None if path is None else scene_file_path(key, kind) for key, path in zip(ids, known, strict=True)]
        scenes = with_column(scenes, f"{kind}_path", paths)
    return scenes


def of_trajectories(rows: pa.Table, trajectories: pa.Table) -> pa.Table:
    """Return the rows of one scene that belong to the given trajectories of that scene."""
    return rows.filter(pc.is_in(rows["trajectory_id"], trajectories["trajectory_id"].combine_chunks()))


def _with_counts_and_splits(trajectories: pa.Table, frames: pa.Table) -> pa.Table:
    """Return the trajectories that have frames, with number of frames and split (null if frames differ)."""
    counted = frames.group_by("trajectory_id").aggregate(
        [("frame_id", "count"), ("split", "count_distinct"), ("split", "min")]
    )
    rows = {row["trajectory_id"]: row for row in counted.to_pylist()}
    ids = trajectories["trajectory_id"].to_pylist()
    trajectories = trajectories.filter(pa.array(name in rows for name in ids))
    rows_of_scene = [rows[name] for name in ids if name in rows]
    n_frames = [row["frame_id_count"] for row in rows_of_scene]
    splits = [row["split_min"] if row["split_count_distinct"] == 1 else None for row in rows_of_scene]
    trajectories = with_column(trajectories, "n_frames", n_frames)
    return with_column(trajectories, "split", splits)


def _sorted_by(table: pa.Table, column: str) -> pa.Table:
    order = np.argsort(table[column].to_numpy(zero_copy_only=False), kind="stable")
    return table.take(pa.array(order))
