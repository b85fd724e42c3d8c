"""Finish a dataset: merge the rows of its trajectories, write overview, index and dataset.json, remove work/.

Killed at any moment, the same command finishes it with the same bytes: dataset.json with `complete` comes after all
that it names, and work/ is removed last.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import pyarrow as pa

from perilune_render.dataset import work
from perilune_render.dataset.overview import overview_png
from perilune_shared.dataset.index import index_rows, scene_file_rows, seal
from perilune_shared.dataset.manifest import Dataset, open_dataset
from perilune_shared.dataset.metadata import DatasetInfo
from perilune_shared.dataset.parts import Written
from perilune_shared.dataset.whole_tables import WholeTables
from perilune_shared.storage.store import Store

_OVERVIEW = "overview.png"
_AHEAD = 32
"""Number of reads in flight, since each request to an object store takes tens of milliseconds."""
_Given = TypeVar("_Given")
_Found = TypeVar("_Found")


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
        found = [each for _, each in _read_ahead(lambda name: work.trajectory_rows(store, name), names)]
        for table in work.OF_TRAJECTORY:
            whole.add(table, pa.concat_tables([part[table] for part, _ in found]))
        files += [own for _, own in found]
    written = whole.finish()
    picture = overview_png(Dataset(store, info))
    store.replace(_OVERVIEW, picture)
    rows = pa.concat_tables([index_rows([*written, Written.of(_OVERVIEW, picture)]), *files])
    seal(store, info.model_copy(update={"counts": whole.counts, "complete": True}), rows)
    remove_work(store)
    return open_dataset(store)


def remove_work(store: Store) -> None:
    """Remove what is left below work/ in a complete dataset."""
    store.delete_below(work.FOLDER)


def _read_ahead(read: Callable[[_Given], _Found], given: Iterable[_Given]) -> Iterator[tuple[_Given, _Found]]:
    """Yield what `read` returns for each of `given`, in order; a few calls run at the same time."""
    waiting: deque[tuple[_Given, Future[_Found]]] = deque()
    with ThreadPoolExecutor(_AHEAD) as readers:
        for each in given:
            waiting.append((each, readers.submit(read, each)))
            if len(waiting) > _AHEAD:
                first, future = waiting.popleft()
                yield first, future.result()
        for first, future in waiting:
            yield first, future.result()
