"""Check a dataset's keys: each key is unique, and each referenced row exists.

A join on broken keys silently returns wrong rows. The checks in this module raise an error at the first fault;
`perilune-manifest validate` reports every fault with its file and row.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import pyarrow as pa
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.parts import Part
from perilune_shared.dataset.schema import KEYS, TABLES
from perilune_shared.dataset.statistics import false_statistics
from perilune_shared.errors import UserError

FRAME_COLUMNS = ("frame_id", "scene_id", "trajectory_id")
_SELECTED_BY = ("scene_id", "trajectory_id", "frame_id", "split")
_HINT = "see `perilune-manifest validate`"


def check_keys(dataset: Dataset) -> None:
    """Raise UserError if a key is not unique, or if a row refers to a missing row of another table.

    Also raises UserError if false statistics of a part would hide rows of a scene, trajectory or split from readers.
    Reads labels one row group at a time and needs 8 bytes of memory per label.
    """
    _check_statistics(dataset)
    check = KeyCheck(dataset, dataset.table("frames", FRAME_COLUMNS))
    _checked_ids_and_keys(dataset, "boulders", check.scene_of)
    for part in dataset.parts("labels"):
        opened = Part(dataset.store, part, "labels")
        for group in range(opened.n_groups):
            check.add_labels(opened.read([*KEYS["labels"], "scene_id"], [group]))
    check.finish()


def _check_statistics(dataset: Dataset) -> None:
    """Raise UserError on false statistics of a column by which readers select row groups."""
    for table, schema in TABLES.items():
        names = [name for name in _SELECTED_BY if name in schema.names]
        for path in dataset.parts(table):
            part = dataset.open_part(path, table)
            stated = part.stated_groups()
            for group in range(part.n_groups):
                for error in false_statistics(part, next(stated, {}), part.read(names, [group])):
                    raise error


class KeyCheck:
    """Checks keys: of scenes, trajectories, frames and craters on creation, of labels as they are added.

    Pass all labels of the dataset to `add_labels`, in batches, then call `finish`. Keys of boulders are not checked,
    since no other row refers to boulders.
    """

    def __init__(self, dataset: Dataset, frames: pa.Table):
        """Check the keys of all tables except labels.

        `frames` has at least the columns FRAME_COLUMNS of the table `frames`. Raises UserError if a key is broken.
        """
        self._dataset = dataset
        scenes = dataset.table("scenes", KEYS["scenes"]).to_pandas()
        _check_unique(dataset, "scenes", scenes)
        self.scene_of = {name: index for index, name in enumerate(scenes["scene_id"])}
        trajectories = dataset.table("trajectories", KEYS["trajectories"])
        _check_unique(dataset, "trajectories", trajectories.to_pandas())
        _check_known(dataset, "trajectories", "scene_id", trajectories["scene_id"], self.scene_of)
        self._scene_of_frame = _check_known(dataset, "frames", "scene_id", frames["scene_id"], self.scene_of)
        known = set(zip(*(trajectories[name].to_pylist() for name in KEYS["trajectories"]), strict=True))
        missing = set(zip(*(frames[name].to_pylist() for name in KEYS["trajectories"]), strict=True)) - known
        if missing:
            raise UserError(
                dataset.store, "frames: trajectory_id", f"no {'/'.join(min(missing))}", f"trajectories; {_HINT}"
            )
        self._frame_of = {name: index for index, name in enumerate(frames["frame_id"].to_pylist())}
        if len(self._frame_of) != len(frames):
            _check_unique(dataset, "frames", frames.select(KEYS["frames"]).to_pandas())
        self._numbers, self._keys = _checked_ids_and_keys(dataset, "craters", self.scene_of)
        self._seen: list[NDArray[np.int64]] = []

    def add_labels(self, rows: pa.Table) -> NDArray[np.int64]:
        """Return the row number (N,) of each label's frame in the table `frames`.

        `rows` has frame_id and crater_id. Raises UserError if a frame or crater is missing, or if a label and its frame
        have different scene_ids.
        """
        frame = _check_known(self._dataset, "labels", "frame_id", rows["frame_id"], self._frame_of)
        if "scene_id" in rows.column_names:
            same_scene = _looked_up(rows["scene_id"], self.scene_of) == self._scene_of_frame[frame]
            if not same_scene.all():
                row = rows.slice(int(np.argmin(same_scene)), 1).to_pylist()[0]
                found = f"{row['scene_id']} in a label of {row['frame_id']}"
                raise UserError(self._dataset.store, "labels: scene_id", found, f"the scene of the frame; {_HINT}")
        ids = rows["crater_id"].to_numpy()
        number = np.searchsorted(self._numbers, ids)
        known = number < len(self._numbers)
        known[known] = self._numbers[number[known]] == ids[known]
        key = self._scene_of_frame[frame] * len(self._numbers) + number
        index = np.searchsorted(self._keys, key[known])
        known[known] = (index < len(self._keys)) & (self._keys[np.minimum(index, len(self._keys) - 1)] == key[known])
        if not known.all():
            row = rows.slice(int(np.argmin(known)), 1).to_pylist()[0]
            found = f"{row['crater_id']} in a label of {row['frame_id']}"
            raise UserError(self._dataset.store, "labels: crater_id", found, f"a crater of the frame's scene; {_HINT}")
        self._seen.append(frame * len(self._numbers) + number)
        return frame

    def finish(self) -> None:
        """Raise UserError if two labels refer to the same frame and crater."""
        keys = np.concatenate(self._seen) if self._seen else np.empty(0, np.int64)
        if not (np.diff(keys) > 0).all():
            keys.sort()
        repeated = np.flatnonzero(np.diff(keys) == 0)
        if len(repeated):
            frame, number = divmod(int(keys[repeated[0]]), len(self._numbers))
            frame_id = next(name for name, index in self._frame_of.items() if index == frame)
            found = f"crater {self._numbers[number]} of {frame_id} twice"
            raise UserError(self._dataset.store, "labels: frame_id+crater_id", found, f"unique keys; {_HINT}")


def _looked_up(column: pa.ChunkedArray, index_of: Mapping[str, int]) -> NDArray[np.int64]:
    """Return the value in `index_of` of each text of a column (N,), or -1 for a missing text."""
    looked_up = []
    for chunk in column.chunks:
        words = chunk.dictionary_encode()
        indices = [*(index_of.get(word, -1) for word in words.dictionary.to_pylist()), -1]
        looked_up.append(np.array(indices, np.int64)[words.indices.fill_null(len(indices) - 1).to_numpy()])
    return np.concatenate(looked_up) if looked_up else np.empty(0, np.int64)


def _checked_ids_and_keys(
    dataset: Dataset, table: str, scene_of: Mapping[str, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Check the keys of craters or boulders.

    Returns all ids and all keys (scene and id as one integer), sorted.
    """
    rows = dataset.table(table, KEYS[table])
    scene = _check_known(dataset, table, "scene_id", rows["scene_id"], scene_of)
    numbers, position = np.unique(rows[KEYS[table][1]].to_numpy(), return_inverse=True)
    keys = np.sort(scene * len(numbers) + position)
    if (np.diff(keys) == 0).any():
        _check_unique(dataset, table, rows.to_pandas())
    return numbers, keys


def _check_known(
    dataset: Dataset, table: str, name: str, column: pa.ChunkedArray, index_of: Mapping[str, int]
) -> NDArray[np.int64]:
    numbers = _looked_up(column, index_of)
    if (numbers < 0).any():
        missing = column[int(np.argmin(numbers))].as_py()
        raise UserError(dataset.store, f"{table}: {name}", f"no {missing}", f"{name.removesuffix('_id')}s; {_HINT}")
    return numbers


def _check_unique(dataset: Dataset, table: str, rows: pd.DataFrame) -> None:
    repeated = rows.duplicated(KEYS[table])
    if repeated.any():
        found = " ".join(map(str, rows[KEYS[table]].iloc[int(np.argmax(repeated))])) + " twice"
        raise UserError(dataset.store, f"{table}: {'+'.join(KEYS[table])}", found, f"unique keys; {_HINT}")
