"""Prepare networks for export: fold batch norms into convolutions, and write attention in standard operations."""

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perilune_train.models.attention import AMPLITUDE, CBAM


class FlightCBAM(nn.Module):
    """CBAM in standard operations: the linear layers of the channel gate become 1 x 1 convolutions.

    Shape: (N, C, H, W) to (N, C, H, W).
    """

    def __init__(self, cbam: CBAM):
        super().__init__()
        self.squeeze, self.excite = _as_convolution(cbam.squeeze), _as_convolution(cbam.excite)
        self.scale, self.centred = cbam.scale, cbam.norm is not None
        self.spatial = cbam.spatial if cbam.norm is None else fuse_conv_bn_eval(cbam.spatial, cbam.norm)

    def forward(self, x: Tensor) -> Tensor:
        mean, largest = x.mean((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
        squeezed = torch.relu(self.squeeze(mean)) + torch.relu(self.squeeze(largest))
        x = x * (self.scale * torch.sigmoid(self.excite(squeezed)))
        pooled = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], dim=1)
        logits = self.spatial(pooled)
        return x * (1 + AMPLITUDE * torch.tanh(logits) if self.centred else self.scale * torch.sigmoid(logits))


def fold(network: nn.Module) -> None:
    """Fold every batch norm of a network's `conv_block`s and replace every CBAM by FlightCBAM, in place."""
    for name, child in list(network.named_children()):
        if isinstance(child, CBAM):
            setattr(network, name, FlightCBAM(child))
            continue
        conv, norm = getattr(child, "conv", None), getattr(child, "norm", None)
        if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            child.conv = fuse_conv_bn_eval(conv, norm)
            del child.norm
        else:
            fold(child)


def _as_convolution(layer: nn.Linear) -> nn.Conv2d:
    convolution = nn.Conv2d(layer.in_features, layer.out_features, 1, bias=False)
    convolution.weight = nn.Parameter(layer.weight.detach()[:, :, None, None].clone(), requires_grad=False)
    return convolution
