"""Compute spatial attention masks of trained networks, and write them to a file for the viewer of the report."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from perilune_shared.errors import UserError
from perilune_shared.storage.files import written_aside
from perilune_train.data.frames import normalised
from perilune_train.models.darknet import AttentionDarknet53
from perilune_train.models.navigator import StackNavigator
from perilune_train.models.yolo import YOLOv3

Masks = dict[str, NDArray[np.float32]]
"""Masks (N, height, width) of N images, resized to the size of the images, by the name of the gate. The gate after
residual unit j of stage i is called block "B_ij" (`AttentionDarknet53`)."""

_BATCH = 8
MAX_PX = 64
"""Largest width of a stored mask, pixels. Masks of deep gates are stored at their lower resolution."""


def detector_masks(detector: YOLOv3, images: NDArray[np.uint8], where: Path) -> Masks:
    """Attention masks (N, height, width) of the detector for frames (N, height, width).

    Raises UserError, which names the checkpoint `where`, if the detector has no attention gates.
    """
    backbone = detector.backbone
    channels = next(backbone.parameters()).shape[1]
    device = next(backbone.parameters()).device

    def network_input(part: NDArray) -> torch.Tensor:
        return torch.from_numpy(normalised(part))[:, None].expand(-1, channels, -1, -1).to(device)

    return _collected(
        backbone,
        [network_input(images[i : i + _BATCH]) for i in range(0, len(images), _BATCH)],
        images.shape[1:],
        where,
    )


def navigator_masks(navigator: StackNavigator, pairs: NDArray[np.uint8], size_px: int, where: Path) -> Masks:
    """Attention masks (N, 2 height, width) of the stack navigator for pairs (N, 2 height, width) of frames.

    The earlier frame is above the later frame. `size_px` is the width of the network's input. Raises UserError, which
    names the checkpoint `where`, if the navigator has no attention gates.
    """
    device = next(navigator.parameters()).device
    first, second = stacked_input(pairs, size_px)
    inputs = [
        navigator.stacked(
            torch.from_numpy(first[None, i : i + _BATCH]).to(device),
            torch.from_numpy(second[None, i : i + _BATCH]).to(device),
        )
        for i in range(0, len(first), _BATCH)
    ]
    return _collected(navigator.backbone, inputs, pairs.shape[1:], where)


def stacked_input(pairs: NDArray[np.uint8], size_px: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Earlier and later frames of pairs (N, 2 height, width), shrunk to the width size_px and normalised."""
    first, second = np.split(pairs, 2, axis=1)
    size = size_px, round(first.shape[1] * size_px / first.shape[2])

    def shrunk(frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        if frames.shape[2] == size_px:
            return normalised(frames)
        return normalised(np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]))

    return shrunk(first), shrunk(second)


def _collected(backbone: AttentionDarknet53, inputs: list[torch.Tensor], size: tuple[int, ...], where: Path) -> Masks:
    masks: dict[str, list[np.ndarray]] = {}
    with torch.no_grad():
        for batch in inputs:
            for name, mask in backbone.attention_masks(batch).items():
                image_masks = mask[:, 0].float().cpu().numpy()
                masks.setdefault(name, []).extend(cv2.resize(m, size[::-1]) for m in image_masks)
    if not masks:
        raise UserError(where, "attention", "none", "a checkpoint of a network with attention gates")
    return {name: np.stack(gate_masks) for name, gate_masks in masks.items()}


def save_masks(path: Path, frame_ids: Sequence[str], masks: Masks) -> None:
    """Write an .npz file with frame_ids (N,), blocks (B,), low (B,), high (B,), and the masks of each block.

    `masks` has arrays (N, height, width) by block. They are stored as uint8 (N, h, w) under the name of the block, at
    reduced size. Values 0 to 255 represent the range from `low` to `high` of the block's masks.
    """
    arrays: dict[str, np.ndarray] = {}
    for block, block_masks in masks.items():
        low, high = float(block_masks.min()), float(block_masks.max())
        width = min(MAX_PX, max(8, block_masks.shape[2] // 2 ** int(block[2])))
        size = width, max(1, round(block_masks.shape[1] * width / block_masks.shape[2]))
        small = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in block_masks])
        arrays[block] = np.rint(255 * (small - low) / max(high - low, 1e-9)).clip(0, 255).astype(np.uint8)
    ends = {
        name: np.array([float(getattr(block_masks, name)()) for block_masks in masks.values()], np.float32)
        for name in ("min", "max")
    }
    with written_aside(path) as aside, aside.open("wb") as file:
        np.savez_compressed(
            file,
            frame_ids=np.array(list(frame_ids), dtype=str),
            blocks=np.array(list(masks), dtype=str),
            low=ends["min"],
            high=ends["max"],
            **arrays,
        )
