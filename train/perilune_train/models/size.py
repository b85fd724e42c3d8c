"""Computing cost of a network."""

import copy

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode


def multiply_adds(network: nn.Module, shape: tuple[int, ...]) -> int:
    """Number of multiply-adds of all convolutions and matrix products, for an input of this shape.

    It is half of torch's count of floating-point operations. As usual, the count leaves out biases, norms, activations,
    products of gates and pooling.
    """
    # torch's `meta` device computes shapes only, which is fast.
    on_meta = copy.deepcopy(network).to("meta").eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        on_meta(torch.empty(shape, device="meta"))
    return counter.get_total_flops() // 2
