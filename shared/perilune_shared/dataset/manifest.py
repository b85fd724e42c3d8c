"""Read a dataset: dataset.json, Parquet parts under manifest/, frames under frames/ or in shards/.

Parts are written atomically and never rewritten. Use:

    dataset = open_dataset("data/small/detect")
    dataset.labels, dataset[0].image                                    # pandas, NumPy
    dataset.table("labels", ["frame_id", "radius_px"], split="test")    # Arrow; reads only these columns and rows
"""

import contextlib
import functools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, overload

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.expression import Condition
from perilune_shared.dataset.frame import Frame
from perilune_shared.dataset.info_file import read_info
from perilune_shared.dataset.metadata import Counts, DatasetInfo
from perilune_shared.dataset.names import SPLITS, stem_of
from perilune_shared.dataset.packed import read_packed, shards_of
from perilune_shared.dataset.part_rows import may_contain, rows_of_part
from perilune_shared.dataset.parts import Part, parquet_files
from perilune_shared.dataset.schema import TABLES
from perilune_shared.errors import UserError, one_line
from perilune_shared.geometry.camera import Camera
from perilune_shared.storage import files
from perilune_shared.storage.store import Address, open_store

LARGEST_FRAME_BYTES = 2**30
"""Maximum size of a PNG or EXR, bytes."""
_MAX_KEPT_OPEN = 32
_MAX_REQUESTS = 16
"""Number of frames that are requested from an object store at the same time."""


class Dataset:
    """An open dataset."""

    _opened: dict[str, Part] | None = None

    def __init__(self, address: Address, info: DatasetInfo):
        self.store = open_store(address)
        self.info = info
        self._listed: dict[str, list[str]] = {}

    @contextlib.contextmanager
    def parts_kept_open(self) -> Iterator[None]:
        """Keep parts open within the block, so that callers that read scene by scene do not check them again.

        Use this only while no process writes to the dataset: a changed part is not read again.
        """
        self._opened = {}
        try:
            yield
        finally:
            self._opened = None

    def open_part(self, path: str, table: str) -> Part:
        """Open a part of a table. Raises UserError as `Part` does."""
        if self._opened is None:
            return Part(self.store, path, table)
        if path not in self._opened:
            part = Part(self.store, path, table)
            while len(self._opened) >= _MAX_KEPT_OPEN:
                del self._opened[next(iter(self._opened))]
            self._opened[path] = part
        return self._opened[path]

    @property
    def camera(self) -> Camera:
        """Camera of the PNGs; the first camera if there are several (see `camera_of`)."""
        return self.info.camera.intrinsics()

    def camera_of(self, row: Mapping[str, Any]) -> Camera:
        """Return the camera of a frame, given its row in the table `frames` with the column `camera`."""
        return self.info.camera_of(_name_of(row, self.info, self.store)).intrinsics()

    def exr_camera_of(self, row: Mapping[str, Any]) -> Camera:
        """Return the camera of a frame's EXR, given its row in the table `frames` with the column `camera`."""
        return self.info.exr_camera_of(_name_of(row, self.info, self.store)).intrinsics()

    @property
    def exr_camera(self) -> Camera:
        """Camera of the EXRs, or of the PNGs without EXRs; the first camera if there are several."""
        return (self.info.exr_camera or self.info.camera).intrinsics()

    @functools.cached_property
    def scenes(self) -> pd.DataFrame:
        """The table `scenes`; cached."""
        return self.table("scenes").to_pandas()

    @functools.cached_property
    def trajectories(self) -> pd.DataFrame:
        """The table `trajectories`; cached."""
        return self.table("trajectories").to_pandas()

    @functools.cached_property
    def frames(self) -> pd.DataFrame:
        """The table `frames`; cached. Row i is frame `dataset[i]`."""
        return self.table("frames").to_pandas()

    @functools.cached_property
    def labels(self) -> pd.DataFrame:
        """The table `labels`; cached, about 200 bytes of memory per label.

        `table` can read single columns or a split.
        """
        return self.table("labels").to_pandas()

    @functools.cached_property
    def craters(self) -> pd.DataFrame:
        """The table `craters`; cached."""
        return self.table("craters").to_pandas()

    def __len__(self) -> int:
        """Number of frames."""
        return self.info.counts.frames

    def __repr__(self) -> str:
        counts, camera = self.info.counts, self.info.camera
        frames = f"{counts.frames} frames of {camera.width_px} x {camera.height_px} px"
        return one_line(
            f"Dataset({self.store}: {frames}, {counts.trajectories} trajectories, {counts.scenes} scenes, "
            f"{counts.labels} labels)"
        )

    @overload
    def __getitem__(self, key: int | str) -> Frame: ...
    @overload
    def __getitem__(self, key: slice) -> list[Frame]: ...
    def __getitem__(self, key: int | str | slice) -> Frame | list[Frame]:
        """Return a frame by its row number in `frames` or by its frame_id, or the list of frames of a slice.

        Raises IndexError or KeyError if the frame does not exist, UserError if its image or labels cannot be read.
        """
        if isinstance(key, slice):
            with self.parts_kept_open():
                return [self[k] for k in range(*key.indices(len(self.frames)))]
        if isinstance(key, str):
            matching = self.frames.index[self.frames["frame_id"] == key]
            if len(matching) == 0:
                raise KeyError(key)
            key = int(matching[0])
        if not -len(self.frames) <= key < len(self.frames):
            raise IndexError(key)
        row = {str(name): value for name, value in self.frames.iloc[key].items()}
        labels = self.table("labels", scene_id=row["scene_id"], trajectory_id=row["trajectory_id"])
        labels = labels.filter(pc.equal(labels["frame_id"], row["frame_id"]))
        ((_, png),) = self.pngs(pa.table({name: [row[name]] for name in ("frame_id", "png_path")}))
        return Frame(row, labels.to_pandas(), png)

    def parts(self, table: str, scene_id: str | None = None, trajectory_id: str | None = None) -> list[str]:
        """Return the sorted paths of the parts of a table, or of those that may have rows with the ids."""
        paths = self._listed.get(table)
        if paths is None:
            paths = parquet_files(self.store, f"manifest/{table}")
            if not self.store.is_local:  # listing an object store takes a request
                self._listed[table] = paths
        return [part for part in paths if may_contain(stem_of(part), scene_id, trajectory_id)]

    def table(
        self,
        table: str,
        columns: Sequence[str] | None = None,
        scene_id: str | None = None,
        trajectory_id: str | None = None,
        split: str | None = None,
        where: Condition | None = None,
    ) -> pa.Table:
        """Read columns of a table as Arrow: all rows, or the rows of a scene, trajectory or split.

        Without `columns`, read all columns. A trajectory_id needs its scene_id. `where` selects rows by a condition on
        columns of this table. `split` has no effect on craters and boulders, which belong to no split. Only the
        required parts, row groups and columns are read. Raises UserError if a part is truncated or has another schema,
        or if the table or a column is unknown.
        """
        _check_names(table, columns)
        if split is not None and split not in SPLITS:
            raise UserError(table, "split", split, "one of " + ", ".join(SPLITS))
        if trajectory_id is not None and scene_id is None:
            raise UserError("table", "scene_id", "None", "the scene_id too: trajectory_ids repeat in each scene")
        if where is not None and where.columns_of_only(table) is None:
            raise UserError(table, "where", where.text, f"a condition only on columns of {table}")
        names = list(columns) if columns is not None else TABLES[table].names
        schema = pa.schema([TABLES[table].field(name) for name in names])
        pieces = [
            rows_of_part(self.open_part(part, table), names, scene_id, trajectory_id, split, where)
            for part in self.parts(table, scene_id, trajectory_id)
        ]
        return pa.concat_tables(pieces).replace_schema_metadata() if pieces else schema.empty_table()

    def scene_ids(self) -> list[str]:
        """Return all scene_ids, sorted."""
        return sorted(self.table("scenes", ["scene_id"])["scene_id"].to_pylist())

    def scene(self, scene_id: str) -> dict[str, pa.Table]:
        """Read all tables of one scene."""
        return {name: self.table(name, scene_id=scene_id) for name in TABLES}

    def file(self, relative: str) -> Path:
        """Return the local path of a file, from its path relative to the dataset.

        Raises UserError if the file is outside the dataset or the dataset is in an object store.
        """
        if self.store.folder is None:
            raise UserError(self.store, "address", "an object store", "a local folder")
        return files.inside(self.store.folder, relative)

    def pngs(self, frames: pa.Table, split: str | None = None) -> Iterator[tuple[str, bytes]]:
        """Yield frame_id and PNG bytes of each row of `frames`, a table with frame_id and png_path.

        If all frames belong to one split, pass `split`, so that shards of other splits are not read. Frames stored as
        files come in the order of the rows, packed frames in the order of the shards. Raises UserError if a frame is
        missing.
        """
        if self.info.images in ("absent", "planned"):
            command = "regenerate" if self.info.images == "absent" else "dataset --manifest"
            expected = f"a dataset with frames; render them with `perilune-render {command}`"
            raise UserError(self.store, "images", self.info.images, expected)
        rows = frames.select(["frame_id", "png_path"]).to_pydict()
        paths = dict(zip(rows["frame_id"], rows["png_path"], strict=True))
        if self.info.images == "packed":
            yield from read_packed(self.store, set(paths), split)
            return
        read = functools.partial(self.store.read, most_bytes=LARGEST_FRAME_BYTES)
        if self.store.is_local:
            for frame_id, relative in paths.items():
                yield frame_id, read(relative)
            return
        with ThreadPoolExecutor(_MAX_REQUESTS) as readers:
            for start in range(0, len(paths), _MAX_REQUESTS):
                portion = list(paths.items())[start : start + _MAX_REQUESTS]
                yield from zip(
                    (name for name, _ in portion), readers.map(read, (path for _, path in portion)), strict=True
                )

    def shards(self, split: str | None = None) -> list[str]:
        """Return the paths of the shards (Parquet files with packed frames) of one split or all, sorted."""
        return shards_of(self.store, split)


def open_dataset(address: Address) -> Dataset:
    """Open a dataset in a local folder or at an address such as s3://bucket/moon.

    Raises UserError if the dataset is missing or damaged, or if it has another schema version.
    """
    store = open_store(address)
    return Dataset(store, read_info(store))


def open_single(address: Address) -> Dataset:
    """Open a dataset that has one camera.

    Raises UserError as `open_dataset` does, and if the dataset has several cameras.
    """
    dataset = open_dataset(address)
    check_single(dataset)
    return dataset


def check_single(dataset: Dataset) -> None:
    """Raise UserError if a dataset has several cameras."""
    names = list(dataset.info.cameras or ())
    if names:
        select = f"perilune-manifest subset {dataset.store} --where \"camera == '{names[0]}'\" --out ..."
        expected = f"one camera; select it with `{select}`"
        raise UserError(dataset.store.at("dataset.json"), "cameras", ", ".join(names), expected)


def _name_of(row: Mapping[str, Any], info: DatasetInfo, where: object) -> str | None:
    name = row["camera"] if isinstance(row["camera"], str) else None
    if info.cameras is not None and name not in info.cameras:
        raise UserError(where, "frames: camera", name, "one of " + ", ".join(info.cameras))
    return name


def count_rows(dataset: Dataset) -> Counts:
    """Return the number of rows of each table, from the footers of its parts."""
    counts = {name: sum(dataset.open_part(part, name).n_rows for part in dataset.parts(name)) for name in TABLES}
    return Counts(**counts)


def _check_names(table: str, columns: Sequence[str] | None) -> None:
    if table not in TABLES:
        raise UserError("table", "name", table, "one of " + ", ".join(TABLES))
    for name in columns or ():
        if name not in TABLES[table].names:
            raise UserError(table, "column", name, "one of " + ", ".join(TABLES[table].names))
