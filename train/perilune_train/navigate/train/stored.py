"""Features of a frozen backbone, computed once: a coarse epoch then trains the recurrent layers only."""

from typing import Any

import torch
from torch import Tensor

from perilune_shared.terminal import progress_bar
from perilune_train.navigate.data.sequences import pair_sequence
from perilune_train.navigate.data.trajectories import Trajectory

_PAIRS = 8
"""Pairs at a time, to bound memory."""


@torch.no_grad()
def stored_features(network: Any, trajectories: list[Trajectory], device: torch.device, bf16: bool) -> list[Tensor]:
    """Features (pairs, channels), float32, of all pairs of each trajectory, from a stack network's frozen backbone.

    The backbone is in evaluation mode, and frames are not augmented, so the features are those of every coarse epoch.
    """
    modes = [(module, module.training) for module in network.backbone.modules()]
    network.backbone.eval()
    found = []
    with progress_bar() as progress:
        total = sum(trajectory.n_pairs for trajectory in trajectories)
        bar = progress.add_task("backbone", total=total, unit="pairs", note="")
        for trajectory in trajectories:
            parts = []
            for start in range(0, trajectory.n_pairs, _PAIRS):
                count = min(_PAIRS, trajectory.n_pairs - start)
                sequence = pair_sequence(trajectory, start, count, warp=False)
                first, second = (torch.from_numpy(part)[None].to(device) for part in (sequence.first, sequence.second))
                with torch.autocast(device.type, torch.bfloat16, enabled=bf16):
                    parts.append(network.features(first, second)[0].float().cpu())
                progress.advance(bar, count)
            found.append(torch.cat(parts))
    for module, training in modes:
        module.training = training
    return found
