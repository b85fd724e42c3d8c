"""Finish a dataset: merge the rows of its trajectories, write overview, index and dataset.json, remove work/.

If the process is killed, the same command completes the dataset with the same bytes. To ensure this, `complete` is set
in dataset.json after all files that it names are written, and work/ is removed last.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import cv2
import numpy as np
import pyarrow as pa

from perilune_render.dataset import work
from perilune_render.labels.drawing import draw_labels, enlarge, padded, sheet_png
from perilune_render.labels.frame_labels import Labels
from perilune_shared.dataset.index import index_rows, scene_file_rows, seal
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.parts import WrittenFile
from perilune_shared.dataset.whole_tables import WholeTables
from perilune_shared.labels.selection import selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_shared.storage.store import Store

_OVERVIEW = "overview.png"
_SHEET_FRAMES, _FRAMES_PER_CAMERA, _COLUMNS = 12, 3, 6
"""Layout of the overview: frames of a single camera, frames per camera if there are several, pictures per row."""
_AHEAD = 32
"""Number of parallel reads; each request to an object store takes tens of milliseconds."""
_Name = TypeVar("_Name")
_Rows = TypeVar("_Rows")


def finish(store: Store, info: DatasetInfo, scenes: Iterable[tuple[str, list[str]]]) -> Dataset:
    """Complete a dataset whose trajectories are all finished.

    `scenes` holds the id of each scene and the ids of its trajectories, in the order of the rows.
    """
    whole = WholeTables(store, replace=True)
    files = []
    for (scene_id, trajectory_ids), rows in _read_ahead(lambda scene: work.scene_rows(store, scene[0]), scenes):
        for table, part in rows.items():
            whole.add(table, part)
        files.append(scene_file_rows(rows["scenes"]))
        names = (f"{scene_id}.{trajectory_id}" for trajectory_id in trajectory_ids)
        finished = [each for _, each in _read_ahead(lambda name: work.trajectory_rows(store, name), names)]
        for table in work.OF_TRAJECTORY:
            whole.add(table, pa.concat_tables([part[table] for part, _ in finished]))
        files += [index for _, index in finished]
    written = whole.finish()
    picture = overview_png(Dataset(store, info))
    store.replace(_OVERVIEW, picture)
    rows = pa.concat_tables([index_rows([*written, WrittenFile.of(_OVERVIEW, picture)]), *files])
    seal(store, info.model_copy(update={"counts": whole.counts, "complete": True}), rows)
    remove_work(store)
    return open_dataset(store)


def remove_work(store: Store) -> None:
    """Remove what remains below work/ in a complete dataset."""
    store.delete_below(work.FOLDER)


def _read_ahead(read: Callable[[_Name], _Rows], names: Iterable[_Name]) -> Iterator[tuple[_Name, _Rows]]:
    """Yield each name with the result of `read(name)`, in order; several calls run in parallel."""
    waiting: deque[tuple[_Name, Future[_Rows]]] = deque()
    with ThreadPoolExecutor(_AHEAD) as readers:
        for each in names:
            waiting.append((each, readers.submit(read, each)))
            if len(waiting) > _AHEAD:
                first, future = waiting.popleft()
                yield first, future.result()
        for first, future in waiting:
            yield first, future.result()


def overview_png(dataset: Dataset) -> bytes:
    """A PNG of frames from the whole dataset, each frame without and with its labels.

    Craters that the selection `visible` accepts are green. With several cameras, each camera has a row.
    """
    frames = dataset.table("frames", ["frame_id", "scene_id", "trajectory_id", "png_path", "camera"]).to_pandas()
    if dataset.info.cameras is None:
        chosen = [_spread(len(frames), _SHEET_FRAMES)]
    else:
        rows = [np.flatnonzero(frames["camera"] == name) for name in dataset.info.cameras]
        chosen = [taken[_spread(len(taken), _FRAMES_PER_CAMERA)] for taken in rows]
    pictures = []
    for frame in frames.iloc[np.concatenate(chosen)].itertuples():
        image = cv2.imdecode(np.frombuffer(dataset.store.read(frame.png_path), np.uint8), cv2.IMREAD_GRAYSCALE)
        labels = dataset.table("labels", scene_id=frame.scene_id, trajectory_id=frame.trajectory_id).to_pandas()
        craters = dataset.table("craters", ["crater_id", "depth_m", "diameter_m"], scene_id=frame.scene_id).to_pandas()
        labelled = labels[labels["frame_id"] == frame.frame_id].merge(craters, on="crater_id")
        drawn = draw_labels(image, Labels.from_table(labelled), selected(labelled, SELECTIONS["visible"]))
        pictures += [enlarge(image, 2), drawn]
    if dataset.info.cameras is not None:
        pictures = padded(pictures, [2 * len(taken) for taken in chosen], _COLUMNS)
    return sheet_png(pictures, _COLUMNS)


def _spread(n: int, n_chosen: int) -> np.ndarray:
    """At most `n_chosen` indices, evenly spread from 0 to n - 1."""
    return np.unique(np.linspace(0, n - 1, n_chosen).astype(int)) if n else np.empty(0, int)
