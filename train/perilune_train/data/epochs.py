"""Batches of one process for all epochs, from one loader that lasts for the whole training."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
from torch.utils import data as torch_data

from perilune_shared.errors import UserError


class DataLost(UserError):
    """A source of training data failed between two steps; the training loop saves its state and ends."""


class EpochBatches(torch_data.Sampler[list[Any]]):
    """Batches of dataset keys: `size` keys each, in the order of the current epoch.

    `keys(epoch)` returns the keys of this process in order. `fewest` is the smallest number of keys of any process. All
    processes take as many batches as the process with the fewest keys, so that each step has one batch of each process;
    the last keys of the other processes may be left out.

    The first epoch starts at batch `start`, for a run that is resumed within an epoch; `len` always counts a whole
    epoch. Lightning sets the epoch before each later epoch.
    """

    def __init__(
        self, keys: Callable[[int], Sequence[Any]], fewest: int, size: int, epoch: int = 0, start: int = 0
    ) -> None:
        self.keys, self.fewest, self.size, self.epoch = keys, fewest, size, epoch
        self.resumed = (epoch, start)
        # Lightning calls `set_epoch` of a batch sampler's attribute `sampler`.
        self.sampler = self

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch of the next iteration."""
        self.epoch = epoch

    def __len__(self) -> int:
        return -(-self.fewest // self.size)

    def __iter__(self) -> Iterator[list[Any]]:
        keys, (resumed_epoch, start) = self.keys(self.epoch), self.resumed
        for batch in range(start if self.epoch == resumed_epoch else 0, len(self)):
            yield list(keys[batch * self.size : (batch + 1) * self.size])


def batch_loader(
    dataset: torch_data.Dataset,
    batches: torch_data.Sampler[list[Any]],
    collate: Callable[[list[Any]], Any],
    workers: int,
    pinned: bool,
) -> torch_data.DataLoader:
    """Return a loader of batches; it loads in `workers` processes that live as long as the loader.

    With 0 workers, it loads in the calling process. With workers, OpenCV uses one thread from now on, in this process
    and in the workers; the workers together use all cores anyway. OpenCV is set before the workers are forked, because
    a worker that stops inherited threads would wait forever. `pinned` puts the batches into page-locked memory, from
    which a GPU copies them while the process continues.
    """
    if workers:
        one_thread()
    return torch_data.DataLoader(
        dataset,
        batch_sampler=batches,
        collate_fn=collate,
        num_workers=workers,
        pin_memory=pinned,
        persistent_workers=workers > 0,
        worker_init_fn=one_thread,
    )


def one_thread(_: int = 0) -> None:
    """Make OpenCV use one thread in this process."""
    # A forked worker inherits the setting; a spawned one does not.
    if cv2.getNumThreads() != 1:
        cv2.setNumThreads(1)
