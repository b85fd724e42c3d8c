"""A split of a dataset with its crater labels, for a custom PyTorch loop: `dataset.torch(split="train")`.

    frames = LabelledFrames(open_single("data/small/detect"), "train", "visible")
    loader = DataLoader(frames, batch_size=8, shuffle=True, collate_fn=frames.collate)
    for images, targets in loader:
        ...  # images (B, 1, height, width); one dictionary per image

The networks of this package use other loaders (`perilune_train.detect.data`). To read a dataset larger than memory, use
`perilune_train.data.stream`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils import data as torch_data

from perilune_shared.config.errors import nearest
from perilune_shared.dataset.frame import ELLIPSE_COLUMNS
from perilune_shared.dataset.manifest import Dataset, check_single
from perilune_shared.dataset.names import SPLITS
from perilune_shared.errors import UserError, one_line
from perilune_shared.labels.selection import read_labels, selected
from perilune_shared.labels.thresholds import SELECTIONS
from perilune_train.data.frames import load_frames

Target = dict[str, Any]
_BOX_COLUMNS = ["bbox_x0_px", "bbox_y0_px", "bbox_x1_px", "bbox_y1_px"]


class LabelledFrames(torch_data.Dataset[tuple[Tensor, Target]]):
    """The frames of a split, in memory, in the order of scene, trajectory and time.

    An item is an image and a target. The image is (1, height, width) float32, 0 to 1; a 16-bit frame gives its upper
    eight bits. The target contains tensors, float32 unless stated: `boxes` (M, 4) x0, y0, x1, y1, pixels; `ellipses`
    (M, 5) centre x and y and semi-axes a and b, pixels, and direction of a, radians; `crater_id` (M,) int64;
    `position_m` (3,) and `rotation_wxyz` (4,) of the camera; and the text `frame_id`.
    """

    def __init__(self, dataset: Dataset, split: str = "train", selection: str = "visible"):
        """Read frames and labels of a split; `selection` (all, paper, visible) chooses the labels.

        Raises UserError if a name is unknown, if the split has no frames, if the dataset has several cameras, or if the
        frames do not fit into memory.
        """
        if split not in SPLITS:
            raise UserError("torch", "split", split, nearest(split, SPLITS))
        if selection not in SELECTIONS:
            raise UserError("torch", "selection", selection, nearest(selection, SELECTIONS))
        check_single(dataset)
        self.split, self.selection, self._where = split, selection, str(dataset.store)
        self.frames = load_frames(dataset, split)
        labels = read_labels(dataset, ["crater_id", *_BOX_COLUMNS, *ELLIPSE_COLUMNS], split)
        labels = labels[selected(labels, SELECTIONS[selection])]
        row_of_frame = {frame_id: row for row, frame_id in enumerate(self.frames.table["frame_id"])}
        row_of_label = labels["frame_id"].map(row_of_frame).to_numpy(np.int64)
        order = np.argsort(row_of_label, kind="stable")
        self._bounds = np.searchsorted(row_of_label[order], np.arange(len(row_of_frame) + 1))
        self._crater_id = labels["crater_id"].to_numpy(np.int64)[order]
        self._boxes = labels[_BOX_COLUMNS].to_numpy(np.float32)[order]
        self._ellipses = labels[ELLIPSE_COLUMNS].to_numpy(np.float32)[order]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[Tensor, Target]:
        index = range(len(self))[index]
        row, labels_of_frame = self.frames.table.iloc[index], slice(self._bounds[index], self._bounds[index + 1])
        target: Target = {
            "boxes": torch.from_numpy(self._boxes[labels_of_frame]),
            "ellipses": torch.from_numpy(self._ellipses[labels_of_frame]),
            "crater_id": torch.from_numpy(self._crater_id[labels_of_frame]),
            "position_m": torch.tensor(np.asarray(row["position_m"]), dtype=torch.float32),
            "rotation_wxyz": torch.tensor(np.asarray(row["rotation_wxyz"]), dtype=torch.float32),
            "frame_id": str(row["frame_id"]),
        }
        return torch.from_numpy(self.frames.images[index])[None].float() / 255, target

    @staticmethod
    def collate(items: Sequence[tuple[Tensor, Target]]) -> tuple[Tensor, list[Target]]:
        """Stack the images (B, 1, height, width); the targets, which differ in length, stay a list."""
        images, targets = zip(*items, strict=True)
        return torch.stack(images), list(targets)

    def __repr__(self) -> str:
        labels = f"{len(self._boxes)} labels by {self.selection}"
        return one_line(f"LabelledFrames({self._where}: {len(self)} frames of {self.split}, {labels})")
