"""Stream the frames of a packed dataset: shuffled, divided among workers, resumable within an epoch.

Use:

    stream = FrameStream(open_single("packed"), "train", batch_size=8, seed=0)
    for epoch in range(10):
        stream.set_epoch(epoch)
        for batch in StreamLoader(stream, workers=2):
            ...  # a list of StreamedFrame, or what `stream.make` returns
            state = stream.state_dict()  # load_state_dict(state) continues after this batch

The order depends only on the seed, the epoch, and the numbers of processes and workers. The row groups of all shards
are permuted and cut into equal shares. Each share is read in windows of a few row groups, and the frames of a window
are permuted. So each frame occurs exactly once in an epoch, and the epoch and the number of the batch are enough to
resume.

Each worker, or the process itself without workers, holds two windows in memory: one in use and one being read. `pack`
limits a row group to 64 frames and 8 MiB (more only for a single frame), so a window takes at most 64 MiB.
"""

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from torch.utils import data as torch_data

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.dataset.packed import SHARDS, open_shard, shard_name
from perilune_shared.dataset.parts import Part
from perilune_shared.errors import UserError
from perilune_train.data.epochs import one_thread
from perilune_train.data.shares import ALONE, Share

_GROUPS_PER_WINDOW = 8
_MAX_OPEN_SHARDS = 16
"""Largest number of shards that a worker keeps open. An open shard of an object store holds its footer."""
_NESTED = ("image", "labels")
COLUMNS = tuple(name for name in SHARDS.names if name not in _NESTED)
"""Columns of the table `frames`; all are read by default."""
_STATE = ("batch_size", "seed", "processes", "workers", "frames")


@dataclass(frozen=True, slots=True)
class StreamedFrame:
    """One frame of the stream."""

    number: int
    """Number of the frame within its split, from 0, in the order of the shards."""
    row: dict[str, Any]
    """The frame's row of the table `frames`."""
    png: bytes
    """Content of the PNG file."""
    labels: pa.StructArray
    """The frame's rows of the table `labels`, without the columns that `row` has."""


@dataclass(frozen=True, slots=True)
class FrameContent:
    """What a stream reads of each frame."""

    columns: tuple[str, ...] = COLUMNS
    """Columns of the table `frames`."""
    images: bool = True
    """Whether to read the images; otherwise `StreamedFrame.png` is empty."""


EVERYTHING = FrameContent()
"""All columns and the images."""


@dataclass(frozen=True)
class _Groups:
    """Row groups of all shards of a split, in the order of the shards."""

    shard: list[str]
    """Path of the shard of each row group (G)."""
    in_shard: NDArray[np.int64]
    """Number of each row group within its shard (G,)."""
    n_frames: NDArray[np.int64]
    """Number of frames of each row group (G,)."""

    @property
    def first(self) -> NDArray[np.int64]:
        """Number of the first frame of each row group (G,)."""
        return np.cumsum(self.n_frames) - self.n_frames


def _unchanged(frames: list[StreamedFrame], epoch: int) -> list[StreamedFrame]:
    return frames


class FrameStream(torch_data.IterableDataset):
    """Batches of one process's share of the frames of a split, in the order that the module describes.

    All processes have the same number of batches, `len(stream)`, of `batch_size` frames each. The last batch of an
    epoch has the remaining frames: at least one, at most batch_size + 1.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        batch_size: int,
        seed: int,
        share: Share = ALONE,
        content: FrameContent = EVERYTHING,
    ):
        """Read the footers of the split's shards.

        `share` selects the frames of this process. Raises UserError if a shard is missing or damaged, or if there are
        fewer frames than processes.
        """
        self.dataset, self.split, self.batch_size, self.seed = dataset, split, batch_size, seed
        self.share, self.columns = share, content.columns
        self.make = _unchanged
        self._nested = _NESTED if content.images else _NESTED[1:]
        self.epoch = self.batches = self.workers = 0
        # Workers live longer than an epoch. They read the epoch and the first batch of the iteration from this tensor.
        self._begun = torch.zeros(2, dtype=torch.int64).share_memory_()
        self._groups = _groups_of(dataset, split)
        self.n_frames = int(self._groups.n_frames.sum())
        if self.n_frames < share.processes:
            expected = f"at least {share.processes}, one for each process"
            raise UserError(dataset.store, f"{split} frames", self.n_frames, expected)

    make: Callable[[list[StreamedFrame], int], Any]
    """Converts the frames of a batch, given the epoch, in the worker that reads them."""

    def __len__(self) -> int:
        return -(-(self.n_frames // self.share.processes) // self.batch_size)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration. A new epoch starts at its first batch."""
        if epoch != self.epoch:
            self.epoch, self.batches = epoch, 0

    def state_dict(self) -> dict[str, int]:
        """Return the position in the stream, and the settings that determine the order of frames."""
        return {"epoch": self.epoch, "batches": self.batches, **self._settings()}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Move to a saved position. Raises UserError if a setting that determines the order of frames differs."""
        for name, value in self._settings().items():
            # The number of workers is unknown before the first iteration.
            if state[name] != value and not (name == "workers" and 0 in (value, state[name])):
                raise UserError("state of the stream", name, value, f"{state[name]}, as when the state was saved")
        self.epoch, self.batches = state["epoch"], state["batches"]

    def _settings(self) -> dict[str, int]:
        values = (self.batch_size, self.seed, self.share.processes, self.workers, self.n_frames)
        return dict(zip(_STATE, values, strict=True))

    def __iter__(self) -> Iterator[Any]:
        """Yield the batches of this worker, or all batches without workers, from batch `batches` of the epoch on.

        A worker yields a UserError instead of raising it, because torch would lose its type (`StreamLoader`).
        """
        worker = torch_data.get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker is not None else (0, 1)
        if worker is not None:
            self.epoch, self.batches = self._begun.tolist()
        try:
            # The loader always asks worker 0 first, so when it resumes, worker 0 must have the next batch.
            yield from self._batches((self.batches + number) % workers, workers)
        except UserError as error:
            if worker is None:
                raise
            yield error

    def _batches(self, lane: int, lanes: int) -> Iterator[Any]:
        """Yield the batches lane, lane + lanes, ... of this process, without those before `self.batches`."""
        share = self.share
        start, stop = (self.n_frames * rank // share.processes for rank in (share.process, share.process + 1))
        sizes = np.full(len(self), self.batch_size)
        sizes[-1] = stop - start - sizes[:-1].sum()
        start += sum(int(sizes[before::lanes].sum()) for before in range(lane))
        numbers = np.arange(len(self))[lane::lanes]
        n_done = int(sizes[numbers[numbers < self.batches]].sum())
        frames = self._frames(start, start + int(sizes[numbers].sum()), n_done)
        for batch in numbers[numbers >= self.batches]:
            yield self.make([next(frames) for _ in range(sizes[batch])], self.epoch)

    def _frames(self, start: int, stop: int, n_done: int) -> Iterator[StreamedFrame]:
        """Yield the frames at positions [start, stop) of the epoch's order of row groups, after the first `n_done`."""
        opened: dict[str, Part] = {}
        with ThreadPoolExecutor(1) as reader:
            pending = []
            for window in self._windows(start, stop, n_done):
                pending.append((window, reader.submit(self._read, opened, np.unique(window[0]))))
                if len(pending) > 1:
                    yield from self._of_window(*pending.pop(0))
            for last in pending:
                yield from self._of_window(*last)

    def _windows(self, start: int, stop: int, n_done: int) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """For each window, yield row group (N,) and row in that group (N,) of its frames, in the order of use."""
        order = np.random.default_rng([self.seed, self.epoch]).permutation(len(self._groups.shard))
        ends = np.cumsum(self._groups.n_frames[order])
        first, last = np.searchsorted(ends, [start, stop - 1], side="right")
        for window in range(first, last + 1, _GROUPS_PER_WINDOW):
            window_groups = range(window, min(window + _GROUPS_PER_WINDOW, last + 1))
            sizes = self._groups.n_frames[order[window_groups]]
            groups = np.repeat(order[window_groups], sizes)
            rows = np.concatenate([np.arange(size) for size in sizes])
            position = np.arange(len(rows)) + ends[window] - sizes[0]
            chosen = np.flatnonzero((position >= start) & (position < stop))
            chosen = np.random.default_rng([self.seed, self.epoch, int(position[chosen[0]])]).permutation(chosen)
            skipped, n_done = chosen[:n_done], max(n_done - len(chosen), 0)
            chosen = chosen[len(skipped) :]
            if len(chosen):
                yield groups[chosen], rows[chosen]

    def _read(self, opened: dict[str, Part], groups: NDArray[np.int64]) -> dict[int, pa.Table]:
        """Read row groups, by number."""
        tables = {}
        for group in groups.tolist():
            path = self._groups.shard[group]
            if path not in opened:
                while len(opened) >= _MAX_OPEN_SHARDS:
                    del opened[next(iter(opened))]
                opened[path] = open_shard(self.dataset.store, path)
            tables[group] = opened[path].read([*self.columns, *self._nested], [int(self._groups.in_shard[group])])
            if len(tables[group]) != self._groups.n_frames[group]:
                got, expected = len(tables[group]), f"{self._groups.n_frames[group]}, as when the stream was opened"
                raise UserError(self.dataset.store.at(path), "rows", got, expected)
        return tables

    def _of_window(self, window: tuple[NDArray[np.int64], NDArray[np.int64]], tables: Any) -> Iterator[StreamedFrame]:
        read, first = tables.result(), self._groups.first
        rows_of = {group: table.select(self.columns).to_pylist() for group, table in read.items()}
        nested = {group: {name: table[name].combine_chunks() for name in self._nested} for group, table in read.items()}
        for group, row in zip(*(part.tolist() for part in window), strict=True):
            png = nested[group]["image"][row]["bytes"].as_py() or b"" if "image" in self._nested else b""
            yield StreamedFrame(int(first[group]) + row, rows_of[group][row], png, nested[group]["labels"][row].values)


def _groups_of(dataset: Dataset, split: str) -> _Groups:
    """Read the row groups of a split's shards.

    Raises UserError if a shard is missing or damaged, or if the split has no shards.
    """
    if dataset.info.images != "packed":
        raise UserError(dataset.store, "images", dataset.info.images, "packed; see `perilune-manifest pack`")
    shards = dataset.shards(split)
    count = int(PurePosixPath(shards[0]).stem.rpartition("-")[2]) if shards else 1
    for number in range(count):
        path = shard_name(split, number, count)
        if path not in shards:
            raise UserError(
                dataset.store.at(path), "shard", "no such file", f"one of the {count} shards of the split {split}"
            )
    with ThreadPoolExecutor(16) as readers:
        sizes = list(readers.map(functools.partial(_group_sizes, dataset), shards))
    return _Groups(
        [path for path, sizes_of_shard in zip(shards, sizes, strict=True) for _ in sizes_of_shard],
        np.array([number for sizes_of_shard in sizes for number in range(len(sizes_of_shard))]),
        np.array([size for sizes_of_shard in sizes for size in sizes_of_shard]),
    )


def _group_sizes(dataset: Dataset, path: str) -> list[int]:
    footer = open_shard(dataset.store, path).file.metadata
    return [footer.row_group(group).num_rows for group in range(footer.num_row_groups)]


class StreamLoader:
    """Batches of a stream, loaded by workers or the calling process; counts the batches in the stream."""

    def __init__(self, stream: FrameStream, workers: int = 0, pinned: bool = False):
        """`pinned` puts the batches into page-locked memory, from which a GPU copies them without waiting."""
        self.stream, self.workers, self.pinned = stream, workers, pinned
        stream.workers = max(workers, 1)
        # Lightning calls `set_epoch` of a loader's attribute `sampler` before each epoch.
        self.sampler = stream

    def __len__(self) -> int:
        return len(self.stream)

    @functools.cached_property
    def _loader(self) -> torch_data.DataLoader:
        if self.workers:
            one_thread()
        return torch_data.DataLoader(
            self.stream,
            batch_size=None,
            num_workers=self.workers,
            pin_memory=self.pinned,
            persistent_workers=self.workers > 0,
            worker_init_fn=one_thread,
        )

    def __iter__(self) -> Iterator[Any]:
        self.stream._begun.copy_(torch.tensor([self.stream.epoch, self.stream.batches]))
        for batch in self._loader:
            if isinstance(batch, UserError):
                raise batch
            self.stream.batches += 1
            yield batch
