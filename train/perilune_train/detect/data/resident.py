"""Training frames and their assignments on the GPU, so that the CPU does not prepare batches.

A GPU trains a detector faster than a process can prepare the batches. Without augmentation a frame does not change
between epochs, so frames and assignments are moved to the GPU once, and batches are gathered there. The tensors of all
batches of one size have equal shapes, so that a step can run as a CUDA graph (`detect/train/captured.py`).
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils import data as torch_data

from perilune_train.data.epochs import EpochBatches, batch_loader
from perilune_train.detect.config import AugmentSettings, DetectConfig
from perilune_train.detect.data.assign import Assignment, Targets, assign
from perilune_train.detect.data.batches import Key, TrainingFrames, batch_labels
from perilune_train.detect.data.split import DetectSplit

_UNCHANGED = AugmentSettings(
    flips_and_turns=False, scale=(1.0, 1.0), gain=0.0, gamma=0.0, stretch=0.0, blur_px=0.0, noise=0.0
)
_MAX_MEMORY_FRACTION = 0.25
"""Largest fraction of a GPU's memory that resident frames may take."""
_PORTION = 256
"""Number of frames whose assignments are computed together."""


@dataclass(frozen=True)
class ResidentScale:
    """Assignments of all F frames for one scale.

    Each frame has K rows; the rows of frames with fewer positive predictors are padded.
    """

    predictors: Tensor
    """Anchor, row and column of each positive predictor (F, K, 3)."""
    boxes: Tensor
    """Label box of each positive predictor: x0, y0, x1, y1 in pixels (F, K, 4)."""
    counted: Tensor
    """False for rows of padding (F, K)."""
    ignored: Tensor
    """Predictors that are neither positive nor negative (F, 3, h, w), bool."""
    correlations: Tensor
    """Correlation of the ellipse in each label box (F, K)."""

    def batch(self, numbers: Tensor) -> Assignment:
        """The assignment of a batch of frames (B,)."""
        predictors, boxes, correlations = self.predictors[numbers], self.boxes[numbers], self.correlations[numbers]
        frame = torch.arange(len(numbers), device=numbers.device)[:, None].expand(predictors.shape[:2])
        rows = torch.cat([frame[..., None], predictors], -1).flatten(0, 1).T
        counted = self.counted[numbers].flatten()
        return Assignment(rows, boxes.flatten(0, 1), self.ignored[numbers], counted, correlations.flatten())


@dataclass(frozen=True)
class ResidentFrames:
    """The frames of a split with their assignments, on one device."""

    images: Tensor
    """Pixels (F, height, width), uint8."""
    scales: list[ResidentScale]
    """Assignments, finest stride first."""

    @classmethod
    def of(cls, split: DetectSplit, config: DetectConfig, anchors: Tensor, device: torch.device) -> "ResidentFrames":
        """Assign all frames of a split to anchors (scales, 3, 2), and move them to a device."""
        ratio = config.anchor_ratio if config.assignment == "several" else None
        height, width = split.frames.images.shape[1:]
        parts: list[Targets] = []
        for start in range(0, len(split), _PORTION):
            labels = split.labels[start : start + _PORTION]
            rows = batch_labels([frame.outlines for frame in labels], [frame.selected for frame in labels])
            shapes = [(len(labels), height // stride, width // stride) for stride in config.strides]
            parts.append(assign(rows, anchors.cpu(), config.strides, shapes, ratio))
        scales = [_padded([targets[k] for targets in parts], device) for k in range(len(config.strides))]
        return cls(torch.as_tensor(split.frames.images).to(device), scales)

    def batch(self, numbers: Tensor, in_channels: int) -> tuple[Tensor, Targets]:
        """Network input (B, in_channels, height, width) and assignments of the frames `numbers` (B,).

        Frames are normalised as by `perilune_train.data.frames.normalised`.
        """
        pixels = self.images[numbers].float()
        deviation, mean = torch.std_mean(pixels, (-2, -1), correction=0, keepdim=True)
        frames = ((pixels - mean) / deviation.clamp(min=1.0))[:, None].expand(-1, in_channels, -1, -1)
        return frames.contiguous(memory_format=torch.channels_last), [scale.batch(numbers) for scale in self.scales]


def _padded(parts: list[Assignment], device: torch.device) -> ResidentScale:
    """Join the assignments of all portions, and pad the rows of each frame to one length."""
    predictors, boxes, correlations = [], [], []
    for part in parts:
        assert part.correlations is not None
        order = torch.argsort(part.predictors[0], stable=True)
        counts = torch.bincount(part.predictors[0], minlength=len(part.ignored)).tolist()
        predictors += list(part.predictors[1:, order].T.split(counts))
        boxes += list(part.boxes[order].split(counts))
        correlations += list(part.correlations[order].split(counts))
    counted = pad_sequence([torch.ones(len(part_boxes), dtype=torch.bool) for part_boxes in boxes], batch_first=True)
    # Pad with the box 0, 0, 1, 1: the loss is computed for all rows, so the padding needs an area.
    filled = pad_sequence([part_boxes - part_boxes.new_tensor([0, 0, 1, 1]) for part_boxes in boxes], batch_first=True)
    return ResidentScale(
        pad_sequence(predictors, batch_first=True).to(device),
        (filled + filled.new_tensor([0, 0, 1, 1])).to(device),
        counted.to(device),
        torch.cat([part.ignored for part in parts]).to(device),
        pad_sequence(correlations, batch_first=True).to(device),
    )


def may_reside(config: DetectConfig) -> bool:
    """Whether the settings allow resident frames.

    They need a single process, and no augmentation, teacher, guidance loss, stream or rendered frames.
    """
    alone = config.devices == config.num_nodes == 1
    plain = config.teacher is None and config.loss.lambda_guide == 0
    return alone and plain and not config.stream and config.fresh is None and config.augment == _UNCHANGED


def fits(split: DetectSplit, device: torch.device) -> bool:
    """Whether the frames of a split take at most a quarter of a GPU's memory; assignments take far less."""
    return split.frames.images.nbytes <= _MAX_MEMORY_FRACTION * torch.cuda.get_device_properties(device).total_memory


class _Numbers(torch_data.Dataset):
    """A dataset whose items are the numbers of the frames."""

    def __getitem__(self, key: Key) -> int:
        return key[1]


def resident_loader(split: DetectSplit, config: DetectConfig, epoch: int = 0, start: int = 0) -> torch_data.DataLoader:
    """Batches of numbers of frames, in the order of `training_loader`."""
    batches = EpochBatches(TrainingFrames(split, config).keys, split.n_frames, config.batch_size, epoch, start)
    return batch_loader(_Numbers(), batches, torch.tensor, 0, False)
