"""Decode the ellipse outputs of the detector (`YOLOv3` with `ellipses`) in torch.

An anchor's ellipse has the bounding box of `decode`. Five further raw outputs complete it:

t           correlation S_xy / sqrt(S_xx S_yy) = MAX_CORRELATION tanh(t) of the ellipse (detect/ellipses.py)
s_x, s_y    standard deviations of the centre, as logarithms
s_a, s_b    standard deviations of the semi-major and the semi-minor axis, as logarithms

A standard deviation is exp(s - 2) sqrt(d) pixels with d = sqrt(w h) of the box in pixels: errors grow about as the
square root of a crater's size, so all craters have similar outputs s.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from perilune_train.models.darknet import conv_block

ELLIPSE_OUTPUTS = 5
_CHANNELS = 48, 64, 96
"""Channels of the tower's maps, finest stride first, at every width of the network."""
MAX_CORRELATION = 0.98
"""Largest magnitude of a correlation that a detector predicts: an ellipse at 45 degrees that is ten times as long as
wide."""
_TYPICAL_LOG_SIGMA = -2.0
_MAX_LOG_SIGMA = 4.0
_MIN_SIDE_PX = 1e-3


class EllipseTower(nn.Module):
    """Predicts the ellipse outputs from maps of the backbone, from fine to coarse.

    The tower starts at the map below the finest stride. At each stride, a 3 x 3 convolution with stride 2 shrinks the
    tower's map; it is joined with the backbone's map and the branch of this stride, and mixed by a 1 x 1 and a 3 x 3
    convolution. The inputs are detached, so training the tower does not change boxes and scores, whose features hold
    little of an ellipse's direction (docs/notebook/2026-11-28-ellipses.md).
    """

    def __init__(self, strides: Sequence[int], below: int, inputs: Sequence[int], anchors: int):
        """`below` are the channels of the map below the finest stride, `inputs` those of map and branch per stride."""
        super().__init__()
        self.strides = tuple(map(str, strides))
        self.down, self.mix, self.output = nn.ModuleDict(), nn.ModuleDict(), nn.ModuleDict()
        for stride, channels, joined in zip(self.strides, _CHANNELS, inputs, strict=True):
            self.down[stride] = conv_block(below, channels, 3, 2)
            self.mix[stride] = nn.Sequential(
                conv_block(channels + joined, channels, 1), conv_block(channels, channels, 3)
            )
            layer = nn.Conv2d(channels, anchors * ELLIPSE_OUTPUTS, 1)
            # The initial ellipses are axis-aligned, with typical deviations.
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
            self.output[stride] = layer
            below = channels

    def forward(self, below: Tensor, maps: Mapping[str, tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
        """Outputs (N, anchors x 5, h, w) of each stride.

        `below` is the map below the finest stride; `maps` are the backbone's map and the branch of each stride.
        """
        outputs = {}
        x = below.detach()
        for stride in self.strides:
            joined = [self.down[stride](x), *(part.detach() for part in maps[stride])]
            x = self.mix[stride](torch.cat(joined, dim=1))
            outputs[stride] = self.output[stride](x)
        return outputs


def decode_correlation(raw: Tensor) -> Tensor:
    """Correlations (...) from raw ellipse outputs (..., 5)."""
    return MAX_CORRELATION * raw[..., 0].tanh()


def decode_sigmas(raw: Tensor, boxes: Tensor) -> Tensor:
    """Standard deviations (..., 4) of centre x, y and both semi-axes, pixels.

    `raw` (..., 5) are ellipse outputs, `boxes` (..., 4) the decoded boxes in pixels.
    """
    sides = (boxes[..., 2:] - boxes[..., :2]).clamp(min=_MIN_SIDE_PX)
    scale = (sides[..., 0] * sides[..., 1]).pow(0.25)
    return scale[..., None] * (raw[..., 1:].clamp(-_MAX_LOG_SIGMA, _MAX_LOG_SIGMA) + _TYPICAL_LOG_SIGMA).exp()


def resized_shapes(shapes: Tensor, boxes: Tensor, new_boxes: Tensor, ratios: Tensor) -> Tensor:
    """Shapes (..., 5) in the coordinates of an image that was resized by the factors `ratios` (2,) before detection.

    `new_boxes` (..., 4) are `boxes` in these coordinates. As `Detections.divided` (detect/evaluate/matching.py).
    """
    factors = semi_axes(new_boxes, shapes[..., 0]) / semi_axes(boxes, shapes[..., 0])
    return torch.cat([shapes[..., :1], shapes[..., 1:3] / ratios, shapes[..., 3:] * factors], dim=-1)


def semi_axes(boxes: Tensor, correlations: Tensor) -> Tensor:
    """Semi-major and semi-minor axes (..., 2), pixels, of ellipses with boxes (..., 4) and correlations (...)."""
    half = (boxes[..., 2:] - boxes[..., :2]).clamp(min=_MIN_SIDE_PX) / 2
    sxx, syy = half[..., 0].square(), half[..., 1].square()
    product = half[..., 0] * half[..., 1]
    major = ((sxx + syy) / 2 + torch.hypot((sxx - syy) / 2, correlations * product)).sqrt()
    minor = product * (1 - correlations.square()).clamp(min=0).sqrt() / major
    return torch.stack([major, minor], dim=-1)
