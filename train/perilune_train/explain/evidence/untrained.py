"""Untrained networks with measured batch statistics: a null of every mask."""

import torch
from torch import nn


@torch.no_grad()
def measure_statistics(network: nn.Module, *given: torch.Tensor) -> None:
    """Set the batch statistics of an untrained network to those of one batch, then switch it to evaluation mode.

    Without measured statistics the features of an untrained network shrink from layer to layer.
    """
    for norm in network.modules():
        if isinstance(norm, nn.BatchNorm2d):
            norm.reset_running_stats()
            norm.momentum = None
    network.train()
    network(*given)
    network.eval()
