"""The detector for flight: inference only, with fewer and simpler operations."""

import copy

import torch
from torch import Tensor, nn

from perilune_train.models.fold import fold
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
