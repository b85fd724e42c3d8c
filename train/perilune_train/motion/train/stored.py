"""Features of a frozen backbone, computed once: a coarse epoch then trains only the recurrent layers."""

from collections.abc import Sequence

import torch
from torch import Tensor

from perilune_shared.console.terminal import progress_bar
from perilune_train.models.navigator import StackNavigator
from perilune_train.motion.data.trajectories import Trajectory
from perilune_train.motion.pose import pooled_features
from perilune_train.motion.train.views import view_homographies


@torch.no_grad()
def stored_features(
    network: StackNavigator,
    trajectories: list[Trajectory],
    device: torch.device,
    bf16: bool,
    views: Sequence[Trajectory] = (),
) -> list[Tensor]:
    """The frozen backbone's averaged features (pairs, inputs), float32, of the pairs of each trajectory.

    The features of `views` follow; these are further versions of the trajectories in the same order (`other_views`).
    The backbone is in evaluation mode and each frame has one warp, so all coarse epochs share the features. The
    features stay on the device.
    """
    modes = [(module, module.training) for module in network.backbone.modules()]
    network.backbone.eval()
    features = []
    with progress_bar() as progress, torch.autocast(device.type, torch.bfloat16, enabled=bf16):
        total = sum(trajectory.n_pairs for trajectory in [*trajectories, *views])
        bar = progress.add_task("backbone", total=total, unit="pairs", note="")
        warps: list[Tensor | None] = [None] * len(trajectories)
        warps += [view_homographies(trajectories[i % len(trajectories)], view) for i, view in enumerate(views)]
        for trajectory, warp in zip([*trajectories, *views], warps, strict=True):
            parts = []
            for part in pooled_features(network, torch.from_numpy(trajectory.images), warp):
                parts.append(part.float())
                progress.advance(bar, len(part))
            features.append(torch.cat(parts))
    for module, training in modes:
        module.training = training
    return features
