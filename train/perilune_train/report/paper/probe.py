"""Measure training time on this machine with a few steps on random frames."""

import time

import torch

from perilune_train.detect.config import DetectConfig
from perilune_train.models.navigator import StackNavigator, StackOptions
from perilune_train.models.yolo import YOLOv3
from perilune_train.motion.config import NavigateConfig
from perilune_train.training.runs import choose_bf16, choose_device

_IMAGES = 4
_STEPS = 3


def detect_seconds(config: DetectConfig, size_px: int) -> float:
    """Seconds per training image of a detector, forward and backward, for square frames."""
    network = YOLOv3(None, config.in_channels, config.width, config.attention, config.strides)
    device = choose_device(config.device)
    images = torch.randn(_IMAGES, config.in_channels, size_px, size_px, device=device)
    images = images.contiguous(memory_format=torch.channels_last)

    def step() -> None:
        with torch.autocast(device, torch.bfloat16, enabled=choose_bf16(config.precision, device)):
            outputs = trained(images)
        sum(output.square().mean() for output in outputs).backward()

    trained = network.to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    return _timed(step, device) / _IMAGES


def navigate_seconds(config: NavigateConfig) -> float:
    """Seconds per training pair of the paper's navigator, forward and backward, for square frames."""
    stack = config.stack
    form = config.in_channels, stack.width, stack.attention, stack.hidden
    network = StackNavigator(*form, StackOptions(stack.pool, stack.stages))
    device = choose_device(config.device)
    trained = network.to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    pairs = [torch.randn(1, _IMAGES, stack.size_px, stack.size_px, device=device) for _ in range(2)]

    def step() -> None:
        with torch.autocast(device, torch.bfloat16, enabled=choose_bf16(config.precision, device)):
            output, _ = trained(*pairs)
        output.square().mean().backward()

    return _timed(step, device) / _IMAGES


def _timed(step, device: str) -> float:
    """Seconds of the fastest of a few steps, after one warm-up step."""
    step()
    seconds = []
    for _ in range(_STEPS):
        if device == "cuda":
            torch.cuda.synchronize()
        started = time.perf_counter()
        step()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return min(seconds)
