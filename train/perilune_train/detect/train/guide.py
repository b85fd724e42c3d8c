"""Guidance of attention gates: a loss that makes one gate of each shallow stage stronger on craters."""

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.data.assign import Targets

GUIDED = ("B_11", "B_22", "B_38")
"""The last gates of the stages of stride 2, 4 and 8."""
_RINGS = ((1.0, 1.0), (1.1, 0.8), (1.2, 0.6), (1.3, 0.4), (1.4, 0.2))
"""Outer radius, divided by the crater's, and value: 1 - G of the paper's mask G."""
_TINY = 1e-6


@torch.no_grad()
def craterness(targets: Targets, frames: int, height: int, width: int, stride: int) -> Tensor:
    """1 - G (frames, 1, height, width): 1 in craters, steps down to 0.2 in rings around them, 0 elsewhere.

    Craters are ellipses in the boxes, pixels, of all labels that predictors of any scale learn. A pixel of the map is
    `stride` pixels wide; the value is that at its middle.
    """
    boxes = torch.cat([found.boxes for found in targets]).float()
    frame = torch.cat([found.places[0] for found in targets])
    # Several predictors learn a label.
    rows = torch.unique(torch.cat([frame[:, None].float(), boxes], 1), dim=0)
    frame, boxes = rows[:, 0].long(), rows[:, 1:]
    v, u = torch.meshgrid(
        (torch.arange(height, device=boxes.device) + 0.5) * stride,
        (torch.arange(width, device=boxes.device) + 0.5) * stride,
        indexing="ij",
    )
    centre, half = (boxes[:, :2] + boxes[:, 2:]) / 2, ((boxes[:, 2:] - boxes[:, :2]) / 2).clamp(min=_TINY)
    x = ((u[0] - centre[:, :1]) / half[:, :1]).square()
    y = ((v[:, :1].T - centre[:, 1:]) / half[:, 1:]).square()
    distance = (x[:, None, :] + y[:, :, None]).sqrt()
    value = torch.zeros_like(distance)
    for reach, level in reversed(_RINGS):
        value = torch.where(distance <= reach, level, value)
    found = torch.zeros(frames, height * width, device=boxes.device)
    value = value.flatten(1)
    return found.scatter_reduce_(0, frame[:, None].expand_as(value), value, "amax").view(frames, 1, height, width)


def guide_loss(masks: dict[str, Tensor], targets: Targets, size_px: tuple[int, int]) -> Tensor:
    """Mean over frames and GUIDED gates of 1 - the Pearson correlation of the mask with the craterness.

    `masks` are the spatial masks (N, 1, h, w) of images (height, width). A frame without craters counts 1.
    """
    frames, _, height, width = masks[GUIDED[0]].shape
    target = craterness(targets, frames, height, width, size_px[1] // width)
    losses = []
    for gate in GUIDED:
        mask = masks[gate].float().flatten(1)
        own = F.adaptive_avg_pool2d(target, (masks[gate].shape[2], masks[gate].shape[3])).flatten(1)
        mask, own = mask - mask.mean(1, keepdim=True), own - own.mean(1, keepdim=True)
        lengths = (mask.square().sum(1) * own.square().sum(1) + _TINY).sqrt()
        losses.append((1 - (mask * own).sum(1) / lengths).mean())
    return torch.stack(losses).mean()
