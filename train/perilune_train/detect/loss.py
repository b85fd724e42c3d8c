"""Complete IoU with the paper's circular prior, and the detection loss."""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.assign import Targets, assign
from perilune_train.detect.config import LossSettings
from perilune_train.models.yolo import decode

_TINY = 1e-7


def ciou_loss(predicted: Tensor, label: Tensor, aspect: Literal["circular", "standard"] = "circular") -> Tensor:
    """1 - IoU + rho^2 / c^2 + alpha v of pairs of boxes (N, 4), x0 y0 x1 y1 in pixels: losses (N,) in float32.

    rho is the distance of the centres and c the diagonal of the box around both. v = 4 / pi^2 (arctan(r) -
    arctan(w / h))^2 with r the label's w / h (`standard`, Zheng et al. 2020, doi 10.1609/aaai.v34i07.6999) or 1
    (`circular`, the paper's prior). alpha = v / (1 - IoU + v) carries no gradient. Boxes without area are allowed.
    """
    predicted, label = predicted.float(), label.float()
    size = (predicted[:, 2:] - predicted[:, :2]).clamp(min=0)
    size_label = (label[:, 2:] - label[:, :2]).clamp(min=0)
    overlap = torch.minimum(predicted[:, 2:], label[:, 2:]) - torch.maximum(predicted[:, :2], label[:, :2])
    intersection = overlap.clamp(min=0).prod(1)
    iou = intersection / (size.prod(1) + size_label.prod(1) - intersection + _TINY)
    around = torch.maximum(predicted[:, 2:], label[:, 2:]) - torch.minimum(predicted[:, :2], label[:, :2])
    shift = (predicted[:, :2] + predicted[:, 2:] - label[:, :2] - label[:, 2:]) / 2
    distance = shift.square().sum(1) / (around.square().sum(1) + _TINY)
    angle = torch.atan2(size[:, 0] + _TINY, size[:, 1] + _TINY)
    if aspect == "circular":
        angle_label = torch.full_like(angle, math.pi / 4)
    else:
        angle_label = torch.atan2(size_label[:, 0] + _TINY, size_label[:, 1] + _TINY)
    v = 4 / math.pi**2 * (angle_label - angle).square()
    with torch.no_grad():
        alpha = v / (1 - iou + v + _TINY)
    return 1 - iou + distance + alpha * v


def detection_loss(
    outputs: list[Tensor],
    targets: Targets,
    anchors: Tensor,
    strides: tuple[int, ...],
    ratio: float,
    settings: LossSettings,
) -> tuple[Tensor, Tensor]:
    """L_ciou and L_obj of raw outputs (N, 3, h, w, 5) per scale; the loss is their weighted sum.

    L_ciou is the mean over positive predictors; L_obj the binary cross-entropy of the objectness, summed over
    positive and (times lambda_noobj) negative predictors, over the number of all predictors. Deviation: the paper
    writes sums; with means its weights 0.05 and 1 let both parts train. Without a positive L_ciou is 0.
    """
    shapes = [(raw.shape[0], raw.shape[2], raw.shape[3]) for raw in outputs]
    box_losses, confidence = [], outputs[0].new_zeros(())
    predictors = sum(raw[..., 4].numel() for raw in outputs)
    for raw, prior, stride, found in zip(
        outputs, anchors, strides, assign(targets, anchors, strides, shapes, ratio), strict=True
    ):
        chosen = raw[found.frame, found.anchor, found.row, found.column].float()
        cells = torch.stack([found.column, found.row], 1)
        box_losses.append(
            ciou_loss(decode(chosen, cells, prior[found.anchor], stride), targets.boxes[found.label], settings.aspect)
        )
        positive = found.positive.float()
        weight = positive + settings.lambda_noobj * (1 - positive) * (~found.free)
        logits = raw[..., 4].float()
        confidence = confidence + F.binary_cross_entropy_with_logits(logits, positive, weight, reduction="sum")
    joined = torch.cat(box_losses)
    # The sum over nothing keeps the graph, so that a batch of empty frames can still be differentiated.
    return joined.sum() / max(len(joined), 1), confidence / predictors
