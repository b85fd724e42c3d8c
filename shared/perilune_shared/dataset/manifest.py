"""Read a dataset: dataset.json, Parquet parts under manifest/, frames under frames/ or packed in images/.

Parts are written atomically and never rewritten. Use::

    dataset = open_dataset("data/small/detect")
    dataset.labels, dataset[0].image                                                    # pandas, NumPy
    dataset.table("labels", ["frame_id", "radius_px"], split="test")                    # Arrow, reads only these
"""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from perilune_shared.dataset.expression import Condition
from perilune_shared.dataset.frame import Frame
from perilune_shared.dataset.metadata import Counts, DatasetInfo, read_info
from perilune_shared.dataset.parts import Part, is_whole
from perilune_shared.dataset.schema import IMAGES, SPLITS, TABLES
from perilune_shared.errors import UserError
from perilune_shared.storage import files

LARGEST_FRAME_BYTES = 2**30
"""Maximum size of a PNG or EXR, bytes."""
_MOST_KEPT_OPEN = 32


class Dataset:
    """A dataset, open for reading."""

    _opened: dict[Path, Part] | None = None

    def __init__(self, root: Path, info: DatasetInfo):
        self.root = root
        self.info = info

    @contextlib.contextmanager
    def parts_kept_open(self) -> Iterator[None]:
        """Open each part and check its footer only once within the block, for callers that read scene by scene.

        Use it only while no process writes to the dataset: changed parts are not reread.
        """
        self._opened = {}
        try:
            yield
        finally:
            self._opened = None

    def open_part(self, path: Path, table: str) -> Part:
        """Open a part of a table. Raises UserError as `Part` does."""
        if self._opened is None:
            return Part(path, table)
        if path not in self._opened:
            part = Part(path, table)
            while len(self._opened) >= _MOST_KEPT_OPEN:
                del self._opened[next(iter(self._opened))]
            self._opened[path] = part
        return self._opened[path]

    @functools.cached_property
    def scenes(self) -> pd.DataFrame:
        """The table scenes; cached."""
        return self.table("scenes").to_pandas()

    @functools.cached_property
    def trajectories(self) -> pd.DataFrame:
        """The table trajectories; cached."""
        return self.table("trajectories").to_pandas()

    @functools.cached_property
    def frames(self) -> pd.DataFrame:
        """The table frames; cached. Row i is frame `dataset[i]`."""
        return self.table("frames").to_pandas()

    @functools.cached_property
    def labels(self) -> pd.DataFrame:
        """The table labels; cached, about 200 bytes of memory per label. `table` can read single columns or a split."""
        return self.table("labels").to_pandas()

    @functools.cached_property
    def craters(self) -> pd.DataFrame:
        """The table craters; cached."""
        return self.table("craters").to_pandas()

    def __len__(self) -> int:
        """Number of frames."""
        return self.info.counts.frames

    def __getitem__(self, place: int | str) -> Frame:
        """Return a frame by its row number in `frames` or by its frame_id.

        Raises IndexError or KeyError if there is no such frame, UserError if its image or labels cannot be read.
        """
        if isinstance(place, str):
            found = self.frames.index[self.frames["frame_id"] == place]
            if len(found) == 0:
                raise KeyError(place)
            place = int(found[0])
        if not -len(self.frames) <= place < len(self.frames):
            raise IndexError(place)
        row = {str(name): value for name, value in self.frames.iloc[place].items()}
        labels = self.table("labels", scene_id=row["scene_id"], trajectory_id=row["trajectory_id"])
        labels = labels.filter(pc.equal(labels["frame_id"], row["frame_id"]))
        ((_, png),) = self.pngs(pa.table({name: [row[name]] for name in ("frame_id", "png_path")}))
        return Frame(row, labels.to_pandas(), png)

    def parts(self, table: str, scene_id: str | None = None, trajectory_id: str | None = None) -> list[Path]:
        """Return a table's part files, sorted by name; with ids, those that may contain matching rows."""
        files = self.root.joinpath("manifest", table).glob("[A-Za-z0-9]*.parquet")
        found = sorted(files, key=lambda part: part.stem)
        return [part for part in found if _may_hold(part.stem, scene_id, trajectory_id)]

    def table(
        self,
        table: str,
        columns: Sequence[str] | None = None,
        scene_id: str | None = None,
        trajectory_id: str | None = None,
        split: str | None = None,
        where: Condition | None = None,
    ) -> pa.Table:
        """Read a table as Arrow: all or some columns; all rows or those of a scene, a trajectory, a split.

        A trajectory_id needs its scene_id. `where` selects rows by a condition on columns of this table; row groups
        whose statistics exclude it are skipped. Only the parts, row groups and columns needed are read. Labels belong
        to the split of their frame; craters and boulders belong to no split. Raises UserError if a part is truncated or
        of another schema, or if the table or a column is unknown.
        """
        _check_names(table, columns)
        if split is not None and split not in SPLITS:
            raise UserError(table, "split", split, "one of " + ", ".join(SPLITS))
        if trajectory_id is not None and scene_id is None:
            raise UserError("table", "scene_id", "None", "the scene too: names of descents repeat in each scene")
        if where is not None and where.columns_of_only(table) is None:
            raise UserError(table, "where", where.text, f"a condition on columns of {table} alone")
        names = list(columns) if columns is not None else TABLES[table].names
        wanted = pa.schema([TABLES[table].field(name) for name in names])
        of_split = split if table != "labels" else None
        pieces = [
            _chosen(self.open_part(part, table), names, scene_id, trajectory_id, of_split, where)
            for part in self.parts(table, scene_id, trajectory_id)
        ]
        rows = pa.concat_tables(pieces).replace_schema_metadata() if pieces else wanted.empty_table()
        if split is not None and table == "labels":
            if "frame_id" not in names:
                return self.table(table, [*names, "frame_id"], scene_id, trajectory_id, split, where).select(names)
            rows = rows.filter(pc.is_in(rows["frame_id"], self._frame_ids(scene_id, trajectory_id, split)))
        return rows

    def _frame_ids(self, scene_id: str | None, trajectory_id: str | None, split: str) -> pa.Array:
        return self.table("frames", ["frame_id"], scene_id, trajectory_id, split)["frame_id"].combine_chunks()

    def scene_ids(self) -> list[str]:
        """Return all scene_ids, sorted."""
        return sorted(self.table("scenes", ["scene_id"])["scene_id"].to_pylist())

    def scene(self, scene_id: str) -> dict[str, pa.Table]:
        """Read all tables of one scene."""
        return {name: self.table(name, scene_id=scene_id) for name in TABLES}

    def file(self, relative: str) -> Path:
        """Return the path of a frame's file. Raises UserError if it is outside the dataset."""
        return files.inside(self.root, relative)

    def pngs(self, frames: pa.Table) -> Iterator[tuple[str, bytes]]:
        """Yield frame_id and PNG bytes of the frames in `frames`, which has frame_id and png_path.

        Frames stored as files come in the order of the rows, packed frames in the order in which they are stored.
        Raises UserError if a frame is missing.
        """
        if self.info.images in ("absent", "planned"):
            made = "regenerate" if self.info.images == "absent" else "dataset --manifest"
            wanted = f"a dataset with its frames; `perilune-render {made}` makes them"
            raise UserError(self.root, "images", self.info.images, wanted)
        rows = frames.select(["frame_id", "png_path"]).to_pydict()
        paths = dict(zip(rows["frame_id"], rows["png_path"], strict=True))
        if self.info.images == "packed":
            yield from self._packed(set(paths))
            return
        for frame_id, relative in paths.items():
            path = self.file(relative)
            if not path.is_file():
                raise UserError(path, "frame", "no such file", "the PNG that the manifest names")
            if path.stat().st_size > LARGEST_FRAME_BYTES:
                raise UserError(path, "size", f"{path.stat().st_size} bytes", f"at most {LARGEST_FRAME_BYTES}")
            yield frame_id, path.read_bytes()

    def _packed(self, wanted: set[str]) -> Iterator[tuple[str, bytes]]:
        missing = set(wanted)
        for shard in self.shards():
            if not missing:
                return
            part = Part(shard, "images", IMAGES)
            for group in part.groups_within("frame_id", min(missing), max(missing) + "\x00"):
                keys = part.read(["frame_id"], [group])["frame_id"].to_pylist()
                if missing.isdisjoint(keys):
                    continue
                images = part.read(["image"], [group])["image"]
                for frame_id, image in zip(keys, images, strict=True):
                    if frame_id in missing:
                        missing.remove(frame_id)
                        yield frame_id, image["bytes"].as_py() or b""
        if missing:
            raise UserError(self.root / "images", "frame_id", f"no {min(missing)}", "every frame of the manifest")

    def shards(self) -> list[Path]:
        """Return the Parquet files that contain packed frames."""
        return sorted(self.root.joinpath("images").glob("[A-Za-z0-9]*.parquet"))


def open_dataset(root: str | Path) -> Dataset:
    """Open a dataset. Raises UserError if it is missing, damaged or of another schema version."""
    return Dataset(Path(root), read_info(Path(root)))


def count_rows(dataset: Dataset) -> Counts:
    """Count the rows of each table, from the footers of its parts."""
    counts = {name: sum(dataset.open_part(part, name).n_rows for part in dataset.parts(name)) for name in TABLES}
    return Counts(**counts)


def _check_names(table: str, columns: Sequence[str] | None) -> None:
    if table not in TABLES:
        raise UserError("table", "name", table, "one of " + ", ".join(TABLES))
    for name in columns or ():
        if name not in TABLES[table].names:
            raise UserError(table, "column", name, "one of " + ", ".join(TABLES[table].names))


def _may_hold(stem: str, scene_id: str | None, trajectory_id: str | None) -> bool:
    """Whether a part of this name may contain rows of a scene, and of a trajectory in it."""
    scene, _, trajectory = stem.partition(".")
    if is_whole(stem) or scene_id is None:
        return True
    return scene == scene_id and (trajectory_id is None or trajectory in ("", trajectory_id))


def _chosen(
    part: Part,
    names: Sequence[str],
    scene_id: str | None,
    trajectory_id: str | None,
    split: str | None,
    where: Condition | None,
) -> pa.Table:
    """Read the rows of a part that belong to a scene, a trajectory and a split; labels are matched by frame_id."""
    columns = part.schema.names
    equal = {"scene_id": scene_id, "trajectory_id": trajectory_id, "split": split}
    equal = {name: value for name, value in equal.items() if value is not None and name in columns}
    by_frame = scene_id is not None and "scene_id" not in columns
    prefix = f"{scene_id}/{trajectory_id}/" if trajectory_id is not None else f"{scene_id}/"
    groups = None
    if is_whole(part.path.stem) and scene_id is not None:
        # In sorted order the frame ids "S/..." are in ["S/", "S0"), since "0" is the character after "/".
        if "frame_id" in columns:
            groups = part.groups_within("frame_id", prefix, prefix[:-1] + "0")
        else:
            groups = part.groups_within("scene_id", scene_id, scene_id + "\x00")
    needed = [*names, *equal, *(["frame_id"] if by_frame else [])]
    expression = None
    if where is not None:
        expression = where.within_table()
        needed += [name for _, name in sorted(where.columns)]
        may_hold = set(part.groups_where(expression))
        groups = [group for group in (range(part.n_groups) if groups is None else groups) if group in may_hold]
    rows = part.read(list(dict.fromkeys(needed)), groups)
    if expression is not None:
        try:
            rows = rows.filter(expression)
        except pa.ArrowException as error:
            raise UserError(part.path, "condition", error, "numbers within the range of their columns") from None
    for name, value in equal.items():
        rows = rows.filter(pc.equal(rows[name], value))
    if by_frame and (is_whole(part.path.stem) or part.path.stem == scene_id):
        rows = rows.filter(pc.starts_with(rows["frame_id"], prefix))
    return rows.select(list(names))
