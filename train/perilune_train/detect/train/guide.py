"""Guidance of attention gates: a loss that makes one gate of each shallow stage stronger on craters."""

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.data.assign import Targets

GUIDED = ("B_11", "B_22", "B_38")
"""The last gates of the stages of stride 2, 4 and 8."""
_REACHES = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Outer radii of the crater and of the rings around it, divided by the crater's radius."""
_LEVELS = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)
"""1 - G in the crater, in each ring and beyond the last ring, where G is the paper's mask."""
_WINDOWS = (4.0, 16.0)
"""Craters are painted in three groups by size. These are the largest radii of the first two groups, rings included, in
pixels of the array that is painted."""
_TINY = 1e-6


@torch.no_grad()
def craterness(targets: Targets, frames: int, height: int, width: int, stride: int) -> Tensor:
    """1 - G (frames, 1, height, width): 1 in craters, steps down to 0.2 in rings around them, 0 elsewhere.

    G is the paper's mask. A crater is the ellipse inscribed in a label box, with axes along the image axes. Only labels
    that are assigned to a predictor (`targets`) count. A pixel of the result is `stride` image pixels wide; values are
    computed at pixel centres.
    """
    boxes = torch.cat([assignment.boxes for assignment in targets]).float()
    frame = torch.cat([assignment.predictors[0] for assignment in targets])
    # Several predictors learn one label; paint it once.
    rows = torch.unique(torch.cat([frame[:, None].float(), boxes], 1), dim=0)
    rows = torch.cat([rows[:, :1], rows[:, 1:] / stride], 1)
    painted = torch.zeros(frames, height, width, device=boxes.device)
    reach = (rows[:, 3:] - rows[:, 1:3]).amax(1) / 2 * _REACHES[-1]
    # Most craters are small: painting these in small windows saves nearly all of the time.
    smaller = torch.zeros_like(reach, dtype=torch.bool)
    for largest in (*_WINDOWS, float("inf")):
        fitting = (reach <= largest) & ~smaller
        if fitting.any():
            _paint(painted, rows[fitting], int(2 * float(reach[fitting].max())) + 2)
        smaller |= fitting
    return painted[:, None]


def _paint(painted: Tensor, rows: Tensor, side: int) -> None:
    """Paint craters into `painted`, each in a window of `side` pixels.

    `rows` (N, 5) are the frame and the box of each crater, in pixels of `painted`.
    """
    _, height, width = painted.shape
    centre, half = (rows[:, 1:3] + rows[:, 3:]) / 2, ((rows[:, 3:] - rows[:, 1:3]) / 2).clamp(min=_TINY)
    first = (centre - side / 2).ceil().long()
    steps = torch.arange(side, device=rows.device)
    u, v = first[:, :1] + steps, first[:, 1:] + steps
    x = ((u + 0.5 - centre[:, :1]) / half[:, :1]).square()
    y = ((v + 0.5 - centre[:, 1:]) / half[:, 1:]).square()
    edges, levels = torch.tensor(_REACHES, device=rows.device).square(), torch.tensor(_LEVELS, device=rows.device)
    value = levels[torch.bucketize(x[:, None, :] + y[:, :, None], edges)]
    pixel = (rows[:, :1].long() * height + v)[:, :, None] * width + u[:, None, :]
    inside = ((v >= 0) & (v < height))[:, :, None] & ((u >= 0) & (u < width))[:, None, :]
    painted.view(-1).scatter_reduce_(0, pixel[inside], value[inside], "amax")


def guide_loss(masks: dict[str, Tensor], targets: Targets, size_px: tuple[int, int]) -> Tensor:
    """Guidance loss: 1 - Pearson correlation of mask and craterness, mean over frames and GUIDED gates.

    `masks` are the spatial masks (N, 1, h, w), by gate; `size_px` is the height and width of the images. The loss of a
    frame without craters is 1.
    """
    frames, _, height, width = masks[GUIDED[0]].shape
    target = craterness(targets, frames, height, width, size_px[1] // width)
    losses = []
    for gate in GUIDED:
        mask = masks[gate].float().flatten(1)
        pooled = F.adaptive_avg_pool2d(target, (masks[gate].shape[2], masks[gate].shape[3])).flatten(1)
        mask, pooled = mask - mask.mean(1, keepdim=True), pooled - pooled.mean(1, keepdim=True)
        lengths = (mask.square().sum(1) * pooled.square().sum(1) + _TINY).sqrt()
        losses.append((1 - (mask * pooled).sum(1) / lengths).mean())
    return torch.stack(losses).mean()
