"""Computing cost of a network."""

import copy
from typing import Any

import torch
from torch import nn


def multiply_adds(network: nn.Module, shape: tuple[int, ...]) -> int:
    """Number of multiply-adds of all convolutions and linear layers, for an input of this shape.

    A convolution has (number of outputs) x (input channels / groups) x (kernel area), a linear layer (number of
    outputs) x (number of inputs). Norms, activations, products of gates and pooling are left out, as usual.
    """
    counted = 0

    def count(layer: Any, _: Any, output: torch.Tensor) -> None:
        nonlocal counted
        if isinstance(layer, nn.Linear):
            counted += output.numel() * layer.in_features
        else:
            counted += output.numel() * layer.weight[0].numel()

    # On torch's `meta` device shapes are propagated and nothing is computed.
    ghost = copy.deepcopy(network).to("meta").eval()
    for layer in ghost.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            layer.register_forward_hook(count)
    with torch.no_grad():
        ghost(torch.empty(shape, device="meta"))
    return counted
