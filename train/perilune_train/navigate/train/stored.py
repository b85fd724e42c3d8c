"""Features of a frozen backbone, computed once: a coarse epoch then trains the recurrent layers only."""

import torch
from torch import Tensor

from perilune_shared.terminal import progress_bar
from perilune_train.models.navigator import StackNavigator
from perilune_train.navigate.data.trajectories import Trajectory
from perilune_train.navigate.pose import pooled_features


@torch.no_grad()
def stored_features(
    network: StackNavigator, trajectories: list[Trajectory], device: torch.device, bf16: bool
) -> list[Tensor]:
    """Averages (pairs, inputs), float32, of the frozen backbone's features of all pairs of each trajectory.

    The backbone is in evaluation mode, and frames are not augmented, so the features are those of every coarse epoch.
    They stay on the device.
    """
    modes = [(module, module.training) for module in network.backbone.modules()]
    network.backbone.eval()
    found = []
    with progress_bar() as progress, torch.autocast(device.type, torch.bfloat16, enabled=bf16):
        total = sum(trajectory.n_pairs for trajectory in trajectories)
        bar = progress.add_task("backbone", total=total, unit="pairs", note="")
        for trajectory in trajectories:
            parts = []
            for part in pooled_features(network, torch.from_numpy(trajectory.images)):
                parts.append(part.float())
                progress.advance(bar, len(part))
            found.append(torch.cat(parts))
    for module, training in modes:
        module.training = training
    return found
