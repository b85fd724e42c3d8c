"""Estimate poses in O_L with a stack network: for a whole trajectory, or pair by pair as in flight.

In training, the LSTM starts from the zero state and runs over `sequence_pairs` pairs. So it does in evaluation: the
pose at each pair is computed from a window of the last `sequence_pairs` pairs. At the start of a trajectory the window
is shorter.
"""

import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from perilune_train.models.navigator import Recurrent, StackNavigator
from perilune_train.motion.data.trajectories import Pose, Trajectory
from perilune_train.motion.network import Scales, decoded_rotation

_PAIRS = {"cpu": 16, "cuda": 32}
"""Number of pairs that pass the backbone together, by device. It bounds the memory. A GPU gets more pairs at a time,
because with few pairs it waits for kernel launches."""


def normalised_frames(frames: Tensor) -> Tensor:
    """Normalise 8-bit frames (..., height, width) on their device, like `perilune_train.data.frames.normalised`."""
    pixels = frames.float()
    deviation, mean = torch.std_mean(pixels, dim=(-2, -1), correction=0, keepdim=True)
    return (pixels - mean) / deviation.clamp(min=1.0)


def warped_frames(frames: Tensor, homographies: Tensor) -> Tensor:
    """Resample 8-bit frames (n, height, width) by homographies (n, 3, 3) from output to input image coordinates.

    Returns floats between 0 and 255. Resampling is bicubic, because bilinear resampling blurs more, and a network could
    mistake blur for another altitude. Beyond the edge the frame is reflected, so that no artificial grey level or edge
    appears.
    """
    height, width = (int(size) for size in frames.shape[1:])
    x = torch.arange(width, device=frames.device) + 0.5
    y = (torch.arange(height, device=frames.device) + 0.5)[:, None]
    # Avoid a matrix product, which autocast would compute in bfloat16.
    rows = homographies[:, :, :, None, None]
    u, v, w = (rows[:, i, 0] * x + rows[:, i, 1] * y + rows[:, i, 2] for i in range(3))
    grid = torch.stack([2 * u / (w * width) - 1, 2 * v / (w * height) - 1], dim=-1)
    pixels = frames[:, None].float()
    sampled = functional.grid_sample(pixels, grid, mode="bicubic", padding_mode="reflection", align_corners=False)
    return sampled[:, 0].clamp(0, 255)


def pooled_features(network: StackNavigator, frames: Tensor, homographies: Tensor | None = None) -> Iterator[Tensor]:
    """Yield averaged backbone features (pairs, inputs) of all pairs of consecutive 8-bit frames (n, height, width).

    Each item has the features of some pairs, on the network's device. If homographies (n, 3, 3) are given, the frames
    are warped first (`warped_frames`).
    """
    device = next(network.parameters()).device
    at_once = _PAIRS.get(device.type, 16)
    for start in range(0, len(frames) - 1, at_once):
        span = slice(start, start + at_once + 1)
        part = frames[span].to(device, non_blocking=True)
        if homographies is not None:
            part = warped_frames(part, homographies[span].to(device, non_blocking=True))
        part = normalised_frames(part)
        yield network.pooled(part[None, :-1], part[None, 1:])[0]


def causal_outputs(recurrent: Recurrent, summaries: Tensor, n_pairs: int) -> Tensor:
    """Compute outputs (pairs, 9) from summaries (pairs, inputs), each from a window that ends at its pair.

    A window has the last `n_pairs` summaries and starts from the zero state. The first full window also gives the
    outputs of the shorter windows at the start.
    """
    windows = summaries.unfold(0, min(n_pairs, len(summaries)), 1).transpose(1, 2).contiguous()
    outputs, _ = recurrent.over_time(windows)
    return torch.cat([outputs[0], outputs[1:, -1]])


def pose_of(output: Tensor, scales: Scales) -> Pose:
    """Convert outputs (n, 9) to poses: positions (n, 3), metres, O_L, and rotation_camera_from_site (n, 3, 3)."""
    output = output.float().cpu()
    position_m = np.array(scales.mean_m) + np.array(scales.spread_m) * output[:, :3].double().numpy()
    return position_m, decoded_rotation(output, scales).double().numpy() @ np.array(scales.mean_rotation)


@torch.no_grad()
def predict_pose(
    network: Any, architecture: dict[str, Any], trajectory: Trajectory, features: Tensor | None = None
) -> Pose:
    """Estimate the poses at the later frames of a trajectory's pairs, with the network in evaluation mode.

    `features` (pairs, inputs) are the output of `StackNavigator.features`, if they are already computed.
    """
    if features is None:
        frames = torch.from_numpy(trajectory.shrunk(architecture["size_px"]).images)
        features = network.scaled(torch.cat(list(pooled_features(network, frames))))
    with network.recurrent.precision(features):
        summaries = network.recurrent.summary(features)
    output = causal_outputs(network.recurrent, summaries, architecture["sequence_pairs"])
    return pose_of(output, Scales(**architecture["scales"]))


@torch.no_grad()
def predict_pose_by_pairs(network: Any, architecture: dict[str, Any], trajectory: Trajectory) -> tuple[Pose, float]:
    """Estimate the poses of a trajectory pair by pair, as in flight; return them and the mean seconds per pair.

    The last `sequence_pairs` summaries of pairs are kept in memory. The time is from frames in memory to the pose; it
    does not include shrinking the frames.
    """
    frames = torch.from_numpy(trajectory.shrunk(architecture["size_px"]).images)
    scales, last = Scales(**architecture["scales"]), deque[Tensor](maxlen=architecture["sequence_pairs"])
    poses = []
    started = time.perf_counter()
    for pair in range(trajectory.n_pairs):
        (pooled,) = pooled_features(network, frames[pair : pair + 2])
        last.append(network.recurrent.summary(network.scaled(pooled)))
        output, _ = network.recurrent.over_time(torch.cat(list(last))[None])
        poses.append(pose_of(output[0, -1:], scales))
    seconds = (time.perf_counter() - started) / trajectory.n_pairs
    return (np.concatenate([pose[0] for pose in poses]), np.concatenate([pose[1] for pose in poses])), seconds
