"""Batches of frames and labels: order of an epoch, shares of several processes, the network's input."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils import data as torch_data

from perilune_train.data.frames import normalised
from perilune_train.detect.config import AugmentSettings, DetectConfig
from perilune_train.detect.data.assign import Targets
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.split import DetectSplit

Array = NDArray[np.float64]
Sample = tuple[NDArray[np.float32], Array, NDArray[np.bool_]]
"""A normalised frame (H, W), its boxes (M, 4) in pixels, and which of them are selected (M,)."""
Batch = tuple[Tensor, Targets]


class TrainingFrames(torch_data.Dataset):
    """A split in the order and with the augmentation of one epoch; both depend on seed and epoch only."""

    def __init__(self, split: DetectSplit, settings: AugmentSettings, seed: int, epoch: int):
        self.split, self.settings, self.key = split, settings, [seed, epoch]
        self.order = np.random.default_rng(self.key).permutation(len(split))

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, place: int) -> Sample:
        index = int(self.order[place])
        labels = self.split.labels[index]
        rng = np.random.default_rng([*self.key, index])
        image, split = self.split.frames.images[index], self.split
        pixels, boxes, selected = augment(image, labels.boxes, labels.selected, split.radius_px, self.settings, rng)
        return normalised(pixels), boxes, selected


class EvaluationFrames(torch_data.Dataset):
    """A split in order, not augmented; each of several `processes` takes every n-th frame."""

    def __init__(self, split: DetectSplit, process: int = 0, processes: int = 1):
        self.split, self.own = split, range(process, len(split), processes)

    def __len__(self) -> int:
        return len(self.own)

    def __getitem__(self, place: int) -> Sample:
        index = self.own[place]
        labels = self.split.labels[index]
        return normalised(self.split.frames.images[index]), labels.boxes, labels.selected


def network_input(images: NDArray[np.float32] | Tensor, in_channels: int) -> Tensor:
    """Convert normalised frames (N, H, W) to the network's input (N, in_channels, H, W), channels last in memory."""
    stacked = torch.as_tensor(images)[:, None].expand(-1, in_channels, -1, -1)
    return stacked.contiguous(memory_format=torch.channels_last)


class ProcessBatches(torch_data.Sampler[list[int]]):
    """Batches of one of several processes, as positions in an epoch's order of frames.

    In every step the processes together take the next `size * processes` positions, each an equal part, so that all
    have the same number of batches and each position is taken once. If the last step has fewer positions than
    processes, they are skipped (at most processes - 1 frames of an epoch, different ones in each epoch).

    Iterates from batch `start` on; the length is that of the whole epoch.
    """

    def __init__(self, count: int, size: int, process: int = 0, processes: int = 1, start: int = 0):
        self.count, self.size, self.process, self.processes, self.start = count, size, process, processes, start

    def __len__(self) -> int:
        whole, rest = divmod(self.count, self.size * self.processes)
        return whole + (rest >= self.processes)

    def __iter__(self) -> Iterator[list[int]]:
        step = self.size * self.processes
        for first in range(self.start * step, len(self) * step, step):
            yield list(range(first, min(first + step, self.count)))[self.process :: self.processes]


@dataclass(frozen=True)
class Collate:
    """Makes a batch (images (N, in_channels, H, W), Targets) from frames. A class, so that `spawn` can pickle it."""

    in_channels: int
    """Input channels of the network."""

    def __call__(self, samples: list[Sample]) -> Batch:
        images, boxes, selected = zip(*samples, strict=True)
        counts = torch.tensor([len(part) for part in boxes])
        return network_input(np.stack(images), self.in_channels), Targets(
            torch.as_tensor(np.concatenate(boxes), dtype=torch.float32),
            torch.repeat_interleave(torch.arange(len(samples)), counts),
            torch.as_tensor(np.concatenate(selected)),
        )


def loader(
    frames: TrainingFrames | EvaluationFrames, config: DetectConfig, share: ProcessBatches | None = None
) -> torch_data.DataLoader:
    """Batches (images (N, in_channels, H, W), Targets) in the given order; with `share` only its frames."""
    return torch_data.DataLoader(
        frames,
        batch_sampler=share or ProcessBatches(len(frames), config.batch_size),
        num_workers=config.workers,
        collate_fn=Collate(config.in_channels),
    )
