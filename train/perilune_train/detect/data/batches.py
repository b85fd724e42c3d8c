"""Make batches of frames and labels: order of an epoch, augmentation, assignment, network input."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils import data as torch_data

from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.data.frames import normalised
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.assign import BatchLabels, Targets, assign
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.data.split import DetectSplit
from perilune_train.training.runs import choose_device

Array = NDArray[np.float64]
Sample = tuple[NDArray[np.float32], Array, NDArray[np.bool_]]
"""A normalised frame (H, W), its outlines (M, 5, see augment.py), and whether each crater is selected (M,)."""
Batch = tuple[Tensor, Targets]
"""Normalised frames (N, H, W) and the assignments of their labels; outside training the assignments are empty."""
Key = tuple[int, ...]
"""Epoch, and number of a frame within one process's share of the split; further numbers belong to subclasses."""


class TrainingFrames(torch_data.Dataset):
    """The frames of one process's share of a split, indexed by epoch and number.

    The augmentation depends on seed, epoch and frame only.
    """

    def __init__(self, split: DetectSplit, config: DetectConfig):
        self.split, self.settings, self.seed = split, config.augment, config.seed

    def order(self, epoch: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers (n,) of the share's frames in the order of an epoch, which depends on seed and epoch only.

        Also returns their positions (n,) in the order of all frames of the split.
        """
        order = np.random.default_rng([self.seed, epoch]).permutation(self.split.n_frames)
        positions = np.flatnonzero(self.split.share.owns(order))
        return order[positions] // self.split.share.processes, positions

    def keys(self, epoch: int) -> list[Key]:
        """Keys of the share's frames in the order of an epoch."""
        return [(epoch, int(number)) for number in self.order(epoch)[0]]

    def __getitem__(self, key: Key) -> Sample:
        return self.augmented(key, self.split.frames.images[key[1]], self.split.labels[key[1]])

    def augmented(self, key: Key, image: NDArray[np.uint8], labels: FrameLabels) -> Sample:
        """An image with its labels, with the augmentation that belongs to the key."""
        epoch, number = key[:2]
        in_split = self.split.share.of(self.split.n_frames)[number]
        rng = np.random.default_rng([self.seed, epoch, in_split])
        pixels, outlines, selected = augment(
            image, labels.outlines, labels.selected, self.split.radius_px, self.settings, rng
        )
        return normalised(pixels), outlines, selected


class EvaluationFrames(torch_data.Dataset):
    """The frames of a share in order, not augmented."""

    def __init__(self, split: DetectSplit):
        self.split = split

    def __len__(self) -> int:
        return len(self.split)

    def __getitem__(self, number: int) -> Sample:
        labels = self.split.labels[number]
        return normalised(self.split.frames.images[number]), labels.outlines, labels.selected


def network_input(images: NDArray[np.float32] | Tensor, in_channels: int) -> Tensor:
    """Convert normalised frames (N, H, W) to the network's input (N, in_channels, H, W), channels last."""
    stacked = torch.as_tensor(images)[:, None].expand(-1, in_channels, -1, -1)
    return stacked.contiguous(memory_format=torch.channels_last)


def batch_labels(outlines: Sequence[Array], selected: Sequence[NDArray[np.bool_]]) -> BatchLabels:
    """Labels of a batch from the outlines (M, 5) and the selection (M,) of each frame."""
    joined = torch.as_tensor(np.concatenate(outlines), dtype=torch.float32)
    frame = torch.repeat_interleave(torch.arange(len(outlines)), torch.tensor([len(part) for part in outlines]))
    return BatchLabels(joined[:, :4], frame, torch.as_tensor(np.concatenate(selected)), joined[:, 4])


@dataclass(frozen=True)
class Collate:
    """Makes a batch of frames. A class, so that `spawn` can pickle it."""

    anchors: Tensor | None
    """Widths and heights of the anchors in pixels (scales, 3, 2), on the CPU; None to return no assignments."""
    strides: tuple[int, ...]
    """Strides of the scales, pixels."""
    ratio: float | None
    """Factor within which an anchor fits a label; None assigns one predictor to each label."""

    def __call__(self, samples: list[Sample]) -> Batch:
        images, outlines, selected = zip(*samples, strict=True)
        frames = torch.as_tensor(np.stack(images))
        if self.anchors is None:
            return frames, []
        labels = batch_labels(outlines, selected)
        count, height, width = frames.shape
        shapes = [(count, height // stride, width // stride) for stride in self.strides]
        return frames, assign(labels, self.anchors, self.strides, shapes, self.ratio)


def training_loader(
    split: DetectSplit, config: DetectConfig, anchors: Tensor, epoch: int = 0, start: int = 0
) -> torch_data.DataLoader:
    """Training batches of a share, in the order of each epoch.

    The first epoch is `epoch`; it starts at batch `start`. `anchors` (scales, 3, 2) are the network's anchors. All
    processes have equally many batches, so up to processes - 1 frames are left out of an epoch; these frames differ
    from epoch to epoch. All other frames are used once.
    """
    return frames_loader(TrainingFrames(split, config), config, anchors, epoch, start)


def frames_loader(
    frames: TrainingFrames, config: DetectConfig, anchors: Tensor, epoch: int = 0, start: int = 0
) -> torch_data.DataLoader:
    """Training batches of `frames`, as from `training_loader`."""
    fewest = frames.split.n_frames // frames.split.share.processes
    batches = EpochBatches(frames.keys, fewest, config.batch_size, epoch, start)
    return batch_loader(frames, batches, collate_of(config, anchors), config.workers, pinned(config))


def evaluation_loader(split: DetectSplit, config: DetectConfig, anchors: Tensor | None = None) -> torch_data.DataLoader:
    """Batches of a share in order, not augmented; they have assignments only if `anchors` are given."""
    frames = EvaluationFrames(split)
    batches = torch_data.BatchSampler(range(len(frames)), config.batch_size, drop_last=False)
    return batch_loader(frames, batches, collate_of(config, anchors), config.workers, pinned(config))


def collate_of(config: DetectConfig, anchors: Tensor | None) -> Collate:
    """Return a collate function that assigns labels to anchors (scales, 3, 2); None disables assignment."""
    ratio = config.anchor_ratio if config.assignment == "several" else None
    return Collate(None if anchors is None else anchors.cpu(), config.strides, ratio)


def pinned(config: DetectConfig) -> bool:
    """Whether to put batches into page-locked memory: True if they are copied to a GPU."""
    return choose_device(config.device) == "cuda"
