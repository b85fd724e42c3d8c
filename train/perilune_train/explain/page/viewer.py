"""Masks of one descent as a small file, for a viewer of frames."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from perilune_shared.storage.files import written_aside
from perilune_train.explain.maps.masks import Masks

LARGEST_PX = 64
"""Largest width of a stored mask; masks of deep gates have fewer pixels of their own."""


def save_masks(path: Path, frame_ids: Sequence[str], masks: Masks) -> None:
    """Write an .npz file with frame_ids (N,), blocks (B,), low (B,), high (B,), and uint8 masks (N, h, w) by block.

    0 to 255 stand for `low` to `high`, the range of the block's masks (N, height, width).
    """
    arrays: dict[str, np.ndarray] = {}
    for block, found in masks.items():
        low, high = float(found.min()), float(found.max())
        width = min(LARGEST_PX, max(8, found.shape[2] // 2 ** int(block[2])))
        size = width, max(1, round(found.shape[1] * width / found.shape[2]))
        small = np.stack([cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in found])
        arrays[block] = np.rint(255 * (small - low) / max(high - low, 1e-9)).clip(0, 255).astype(np.uint8)
    ends = {
        name: np.array([float(getattr(found, name)()) for found in masks.values()], np.float32)
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
