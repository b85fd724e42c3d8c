"""Training frames of the detector as a stream, for packed datasets larger than memory."""

from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from torch import Tensor

from perilune_shared.dataset.manifest import Dataset
from perilune_train.data.frames import decode, normalised
from perilune_train.data.shares import Share
from perilune_train.data.stream import FrameContent, FrameStream, StreamedFrame, StreamLoader
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.augment import augment
from perilune_train.detect.data.batches import Batch, Collate, Sample, collate_of, pinned
from perilune_train.detect.data.ignored import Craters, read_craters
from perilune_train.detect.data.labels import FrameLabels, LabelLimits, frame_labels
from perilune_train.detect.data.split import check_frame_size, evaluated_range

_COLUMNS = ("frame_id", "scene_id", "position_m", "rotation_wxyz", "png_bytes")
_SAMPLED_FRAMES = 2048
_MAX_SCENES = 16


@dataclass(frozen=True)
class StreamedSplit:
    """The training split as a stream; see FrameStream."""

    stream: FrameStream
    """Frames of this process's share."""
    radius_px: tuple[float, float]
    """Range of radii that are labelled and evaluated, pixels."""
    label_sizes_px: NDArray[np.float64]
    """Widths and heights of the selected labels of up to 2,048 frames from random row groups, pixels (S, 2)."""


def open_streamed(dataset: Dataset, config: DetectConfig, share: Share) -> StreamedSplit:
    """Open the training split of a packed dataset as a stream.

    Raises UserError if a shard is damaged or missing, if the network cannot use the frame size, or if there are fewer
    frames than processes.
    """
    check_frame_size(dataset)
    radius_px = evaluated_range(dataset, config.labels)
    sampled = FrameStream(dataset, "train", 64, config.seed, content=FrameContent(_COLUMNS, images=False))
    labels = _Labels(dataset, config, radius_px)
    sizes = []
    for batch in sampled:
        boxes = [frame.boxes[frame.selected] for frame in map(labels, batch)]
        sizes += [frame[:, 2:] - frame[:, :2] for frame in boxes]
        if len(sizes) >= _SAMPLED_FRAMES:
            break
    stream = FrameStream(dataset, "train", config.batch_size, config.seed, share, FrameContent(_COLUMNS))
    # A resumed run compares the number of workers before it creates a loader.
    stream.workers = max(config.workers, 1)
    return StreamedSplit(stream, radius_px, np.concatenate(sizes))


def streamed_loader(
    split: StreamedSplit, config: DetectConfig, anchors: Tensor, epoch: int = 0, start: int = 0
) -> StreamLoader:
    """Training batches of a stream, in the order of each epoch.

    The first epoch is `epoch`; it starts at batch `start`. `anchors` (scales, 3, 2) are the network's anchors.
    """
    stream = split.stream
    stream.make = _Batches(_Labels(stream.dataset, config, split.radius_px), collate_of(config, anchors))
    stream.epoch, stream.batches = epoch, start
    return StreamLoader(stream, config.workers, pinned(config))


@dataclass(frozen=True)
class _Labels:
    """Labels and ignored craters of streamed frames; keeps the craters of recently used scenes."""

    dataset: Dataset
    config: DetectConfig
    radius_px: tuple[float, float]
    scenes: dict[str, Craters] = field(default_factory=dict)

    def __call__(self, frame: StreamedFrame) -> FrameLabels:
        """Return the labels of a frame. Raises UserError if the crater of a label is missing."""
        scene_id = frame.row["scene_id"]
        craters = self.scenes.pop(scene_id, None)
        if craters is None:
            craters = read_craters(self.dataset, scene_id)
        while len(self.scenes) >= _MAX_SCENES:
            del self.scenes[next(iter(self.scenes))]
        self.scenes[scene_id] = craters
        labels = pa.Table.from_struct_array(frame.labels)
        limits = LabelLimits(self.config.labels, self.radius_px, self.config.augment.scale)
        return frame_labels(self.dataset.store, self.dataset.camera, frame.row, labels, craters, limits)


@dataclass(frozen=True)
class _Batches:
    """Makes a batch of streamed frames. A class, so that `spawn` can pickle it."""

    labels: _Labels
    collate: Collate

    def __call__(self, frames: list[StreamedFrame], epoch: int) -> Batch:
        return self.collate([self.sample(frame, epoch) for frame in frames])

    def sample(self, frame: StreamedFrame, epoch: int) -> Sample:
        """Decode and augment a frame; the augmentation depends on seed, epoch and frame only."""
        config, camera, labels = self.labels.config, self.labels.dataset.info.camera, self.labels(frame)
        name, size = frame.row["frame_id"], frame.row["png_bytes"]
        image = decode(frame.png, f"{self.labels.dataset.store}/{name}", camera.height_px, camera.width_px, size)
        rng = np.random.default_rng([config.seed, epoch, frame.number])
        pixels, outlines, selected = augment(
            image, labels.outlines, labels.selected, self.labels.radius_px, config.augment, rng
        )
        return normalised(pixels), outlines, selected
