"""Shares of processes and their batches in every epoch."""

import os

import cv2
import numpy as np
import pytest
from torch.utils.data import Dataset

from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.data.shares import Share


def batches(count, size, share, epoch=0, start=0):
    def keys(epoch):
        order = np.random.default_rng(epoch).permutation(count)
        return [(epoch, int(number)) for number in order[share.owns(order)]]

    return EpochBatches(keys, count // share.processes, size, epoch, start)


@pytest.mark.parametrize(("count", "size", "processes"), [(24, 4, 2), (25, 4, 2), (27, 4, 2), (10, 4, 1), (7, 2, 3)])
def test_shares_are_disjoint_and_of_equal_number(count, size, processes):
    shares = [Share(process, processes) for process in range(processes)]
    assert sorted(number for share in shares for number in share.of(count)) == list(range(count))
    left = set()
    for epoch in range(4):
        taken = [list(batches(count, size, share, epoch)) for share in shares]
        assert {len(own) for own in taken} == {len(batches(count, size, shares[0]))}
        assert all(1 <= len(batch) <= size for own in taken for batch in own)
        for share, own in zip(shares, taken, strict=True):
            assert {key for batch in own for key in batch} <= {(epoch, number) for number in share.of(count)}
        seen = [number for own in taken for batch in own for _, number in batch]
        assert len(set(seen)) == len(seen) > count - processes
        left |= set(range(count)) - set(seen)
    # Other frames are left out in other epochs.
    assert not left or len(left) > count % (size * processes)


def test_a_resumed_epoch_starts_within_and_the_next_one_at_its_start():
    whole, resumed = batches(10, 3, Share()), batches(10, 3, Share(), epoch=1, start=2)
    whole.set_epoch(1)
    assert list(resumed) == list(whole)[2:] and len(resumed) == len(whole) == 4
    for one in (whole, resumed):
        one.set_epoch(2)
    assert list(resumed) == list(whole)


class Processes(Dataset):
    """The process in which an item is loaded."""

    def __getitem__(self, key):
        return key[0], os.getpid()


def test_workers_live_through_all_epochs():
    loader = batch_loader(Processes(), batches(6, 2, Share()), list, workers=1, pinned=False)
    seen = []
    for epoch in range(3):
        loader.batch_sampler.set_epoch(epoch)
        seen += [item for batch in loader for item in batch]
    assert [epoch for epoch, _ in seen] == [0] * 6 + [1] * 6 + [2] * 6
    assert len({process for _, process in seen}) == 1 and seen[0][1] != os.getpid()


class Blurred(Dataset):
    """Large images, which OpenCV blurs with several threads."""

    def __getitem__(self, key):
        return cv2.GaussianBlur(np.ones((2000, 2000), np.float32), (0, 0), 3).shape


def test_workers_use_opencv_though_the_calling_process_has_used_it():
    """A forked worker that stopped the threads of this process would wait for ever."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(4)
    try:
        Blurred()[0]
        loader = batch_loader(Blurred(), batches(2, 1, Share()), list, workers=1, pinned=False)
        loader.timeout = 30
        assert list(loader) == [[(2000, 2000)]] * 2
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(threads)
