"""The detector for flight: inference only, with fewer and simpler operations."""

import copy

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perilune_train.models.attention import CBAM
from perilune_train.models.yolo import YOLOv3, decode


class FlightDetector(nn.Module):
    """Images (N, in_channels, size_px, size_px) to boxes (N, K, 4), x0 y0 x1 y1 in pixels, and scores (N, K).

    Equal to `YOLOv3.detect` up to rounding: batch norm is folded into the convolutions (exactly: W' = W g / sqrt(v +
    eps), b' = beta - m g / sqrt(v + eps)), CBAM has no custom backward pass, decoding is included, suppression is not.
    The given network is not changed.
    """

    def __init__(self, network: YOLOv3, size_px: int = 256):
        super().__init__()
        if size_px % 32:
            raise ValueError(f"size_px is {size_px}, not a multiple of 32")
        self.network = copy.deepcopy(network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.network.eval().requires_grad_(False)
        fold(self.network)
        for scale, stride in enumerate(network.strides):
            at = torch.arange(size_px // stride, dtype=torch.float32)
            rows, columns = torch.meshgrid(at, at, indexing="ij")
            self.register_buffer(f"cells_{scale}", torch.stack([columns, rows], dim=-1))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        boxes, scores = [], []
        for scale, raw in enumerate(self.network(images)):
            anchors = self.network.anchors[scale][:, None, None, :]
            cells = getattr(self, f"cells_{scale}")
            boxes.append(decode(raw, cells, anchors, self.network.strides[scale]).flatten(1, 3))
            scores.append(raw[..., 4].sigmoid().flatten(1))
        return torch.cat(boxes, 1), torch.cat(scores, 1)


class FlightCBAM(nn.Module):
    """CBAM in standard operations, the channel gate's linear layers as 1 x 1 convolutions. (N, C, H, W) to the same."""

    def __init__(self, cbam: CBAM):
        super().__init__()
        self.squeeze, self.excite = _as_convolution(cbam.squeeze), _as_convolution(cbam.excite)
        self.spatial, self.scale = cbam.spatial, cbam.scale

    def forward(self, x: Tensor) -> Tensor:
        mean, largest = x.mean((2, 3), keepdim=True), x.amax((2, 3), keepdim=True)
        squeezed = torch.relu(self.squeeze(mean)) + torch.relu(self.squeeze(largest))
        x = x * (self.scale * torch.sigmoid(self.excite(squeezed)))
        pooled = torch.cat([x.mean(1, keepdim=True), x.amax(1, keepdim=True)], dim=1)
        return x * (self.scale * torch.sigmoid(self.spatial(pooled)))


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
    made = nn.Conv2d(layer.in_features, layer.out_features, 1, bias=False)
    made.weight = nn.Parameter(layer.weight.detach()[:, :, None, None].clone(), requires_grad=False)
    return made
