"""Frames and labels of a split for the detector, in memory."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from perilune_shared.dataset.manifest import Dataset
from perilune_shared.errors import UserError
from perilune_shared.labels.selection import label_bound_px
from perilune_train.data.frames import FrameStore, frame_table, load_frames
from perilune_train.data.shares import ALONE, Share
from perilune_train.detect.config import COARSEST_STRIDE, LabelSettings
from perilune_train.detect.data.labels import FrameLabels, LabelLimits, read_split_labels

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DetectSplit:
    """One split in memory, or one process's share of it."""

    frames: FrameStore
    """Pixels and poses of the share."""
    labels: Sequence[FrameLabels]
    """One entry per frame of the share."""
    radius_px: tuple[float, float]
    """Range of radii that are labelled and evaluated, pixels."""
    label_sizes_px: Array
    """Widths and heights of the selected labels of the whole split, pixels (S, 2)."""
    n_frames: int
    """Number of frames of the whole split."""
    share: Share = ALONE
    """The share of the split that is in memory."""

    def __len__(self) -> int:
        return len(self.labels)

    def first(self, count: int) -> "DetectSplit":
        """The first `count` frames of this split, as a separate split."""
        frames = FrameStore(self.frames.table.iloc[:count], self.frames.images[:count])
        labels = self.labels[:count]
        boxes = np.concatenate([part.boxes[part.selected] for part in labels])
        return replace(
            self, frames=frames, labels=labels, label_sizes_px=boxes[:, 2:] - boxes[:, :2], n_frames=len(labels)
        )


def load_split(
    dataset: Dataset,
    split: str,
    settings: LabelSettings,
    scale: tuple[float, float] = (1.0, 1.0),
    share: Share = ALONE,
) -> DetectSplit:
    """Load the frames and labels of a split, or of one process's share of it.

    Training and evaluation ignore craters whose radius is slightly outside the labelled range (`detect.data.ignored`).
    `scale` has the smallest and the largest factor by which frames will be resized; a wider interval makes the range of
    ignored craters wider. The edge scoring rule counts false positives down to EDGE (`detect.evaluate.matching`) times
    the smallest labelled radius, so it needs ignored craters below this radius: pass 1 / EDGE as the largest factor.

    Raises UserError if a file is damaged, if the network cannot use the frame size, or if there are fewer frames than
    processes.
    """
    check_frame_size(dataset)
    table = frame_table(dataset, split)
    if len(table) < share.processes:
        expected = f"at least {share.processes}, one for each process"
        raise UserError(dataset.store, f"{split} frames", len(table), expected)
    frames = load_frames(dataset, split, share, table)
    radius_px = evaluated_range(dataset, settings)
    labels, sizes_px = read_split_labels(dataset, table, share, LabelLimits(settings, radius_px, scale))
    return DetectSplit(frames, labels, radius_px, sizes_px, len(table), share)


def check_frame_size(dataset: Dataset) -> None:
    """Raise UserError if a side of the frames is not a multiple of the network's coarsest stride."""
    camera = dataset.info.camera
    for field, size in (("width_px", camera.width_px), ("height_px", camera.height_px)):
        if size % COARSEST_STRIDE:
            nearest = max(1, round(size / COARSEST_STRIDE)) * COARSEST_STRIDE
            expected = f"a multiple of {COARSEST_STRIDE}, the network's coarsest stride"
            raise UserError(dataset.store, field, size, f"{expected}; render or develop the frames at {nearest} px")


def evaluated_range(dataset: Dataset, settings: LabelSettings) -> tuple[float, float]:
    """Smallest and largest selected radius, pixels.

    If the settings have no radii, returns the extremes of all labels of the dataset; NaN if there are no labels. If the
    settings have only a smallest radius, the largest radius is the dataset's upper limit for labels (`label_bound_px`).
    """
    if settings.radius_px is None:
        limits = pc.min_max(dataset.table("labels", ["radius_px"])["radius_px"]).as_py()
        extremes_px = [np.nan if limits[key] is None else float(limits[key]) for key in ("min", "max")]
        return extremes_px[0], extremes_px[1]
    smallest_px, largest_px = settings.radius_px
    return smallest_px, label_bound_px(dataset.info) if largest_px is None else largest_px
