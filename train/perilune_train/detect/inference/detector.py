"""A trained detector and its detections of a split."""

import time
from pathlib import Path

import torch

from perilune_shared.errors import UserError
from perilune_shared.terminal import progress_bar
from perilune_train.detect.config import DetectConfig
from perilune_train.detect.data.split import DetectSplit
from perilune_train.detect.evaluate.matching import Detections
from perilune_train.detect.inference.scales import detect_at_scales
from perilune_train.models.yolo import YOLOv3
from perilune_train.training import runs


def load_detector(path: Path) -> YOLOv3:
    """Load the network of a detect run's best.ckpt, in evaluation mode. Raises UserError on another kind of file."""
    content = runs.load_weights(path)
    architecture = content["architecture"]
    if set(architecture) != {"in_channels", "width", "attention", "strides"}:
        raise UserError(path, "architecture", sorted(architecture), "a detect run's checkpoint")
    network = YOLOv3(None, **architecture)
    runs.fill(network, content["state_dict"], path)
    return network.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def detect_split(
    network: YOLOv3, split: DetectSplit, name: str, config: DetectConfig, device: str, bf16: bool
) -> tuple[list[Detections], float]:
    """Detections of all frames of a split, and frames per second."""
    with progress_bar() as progress:
        bar = progress.add_task(f"detect {name}", total=len(split), unit="frames", note="")
        started = time.perf_counter()
        network = network.to(device).eval()
        found: list[Detections] = []
        for start in range(0, len(split), config.batch_size):
            frames = split.frames.images[start : start + config.batch_size]
            found += detect_at_scales(network, frames, config, device, bf16)
            progress.advance(bar, len(frames))
        return found, len(split) / (time.perf_counter() - started)
