"""Settings of navigation networks that train in seconds, and a detector whose backbone fits them."""

from pathlib import Path

import torch

from perilune_train.models.yolo import YOLOv3
from perilune_train.motion.config import NavigateConfig
from perilune_train.training.runs import save_weights

NETWORK = {
    "size_px": 64,
    "width": 0.125,
    "hidden": 16,
    "sequence_pairs": 4,
    "batch_sequences": 2,
    "coarse_epochs": 1,
    "fine_epochs": 1,
    "learning_rate": 1e-3,
}
"""One network, trained for two epochs."""


def pose_settings(attention: str, fusion: str = "stack", **changes: object) -> NavigateConfig:
    """A stack network that learns the pose in O_L, with two coarse epochs."""
    stack = NETWORK | {"coarse_epochs": 2, "target": "pose", "attention": attention, "pool": 2, "dropout": 0.2}
    return NavigateConfig(precision="float32", device="cpu", fusion=fusion, warp=NETWORK, stack=stack | changes)


def saved_detector(folder: Path, attention: str, strides: list[int]) -> Path:
    """A detector of width 0.125 and one channel, with random weights."""
    torch.manual_seed(3)
    architecture = {"in_channels": 1, "width": 0.125, "attention": attention, "strides": strides}
    save_weights(folder / "best.ckpt", architecture, YOLOv3(None, **architecture))
    return folder / "best.ckpt"
