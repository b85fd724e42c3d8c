"""Complete IoU with the paper's circular prior, and the detection loss.

For each scale, `detection_loss` gathers the positive predictors, decodes their boxes, and computes:

L_ciou   the complete IoU loss of these boxes with their labels
L_obj    the binary cross-entropy of the objectness of positive and negative predictors, without ignored predictors
"""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.config import LossSettings
from perilune_train.detect.data.assign import Targets, flat_predictors
from perilune_train.models.boxes import iou
from perilune_train.models.yolo import decode

_TINY = 1e-7


def ciou_loss(predicted: Tensor, label: Tensor, aspect: Literal["circular", "standard"] = "circular") -> Tensor:
    """CIoU losses (N,), float32, of pairs of boxes (N, 4), x0 y0 x1 y1 in pixels.

    The loss is 1 - IoU + rho^2 / c^2 + alpha v. rho is the distance between the centres, and c the diagonal of the box
    around both. v = 4 / pi^2 (arctan(r) - arctan(w / h))^2 with r the label's w / h (`standard`, Zheng et al. 2020, doi
    10.1609/aaai.v34i07.6999) or 1 (`circular`, the paper's prior). alpha = v / (1 - IoU + v) carries no gradient. Boxes
    without area are allowed.
    """
    predicted, label = predicted.float(), label.float()
    size = (predicted[:, 2:] - predicted[:, :2]).clamp(min=0)
    size_label = (label[:, 2:] - label[:, :2]).clamp(min=0)
    overlap = iou(predicted, label)
    enclosing = torch.maximum(predicted[:, 2:], label[:, 2:]) - torch.minimum(predicted[:, :2], label[:, :2])
    shift = (predicted[:, :2] + predicted[:, 2:] - label[:, :2] - label[:, 2:]) / 2
    distance = shift.square().sum(1) / (enclosing.square().sum(1) + _TINY)
    angle = torch.atan2(size[:, 0] + _TINY, size[:, 1] + _TINY)
    if aspect == "circular":
        angle_label = torch.full_like(angle, math.pi / 4)
    else:
        angle_label = torch.atan2(size_label[:, 0] + _TINY, size_label[:, 1] + _TINY)
    v = 4 / math.pi**2 * (angle_label - angle).square()
    with torch.no_grad():
        alpha = v / (1 - overlap + v + _TINY)
    return 1 - overlap + distance + alpha * v


def detection_loss(
    outputs: list[Tensor], targets: Targets, anchors: Tensor, strides: tuple[int, ...], settings: LossSettings
) -> tuple[Tensor, Tensor]:
    """L_ciou and L_obj of raw outputs (N, 3, h, w, 5) per scale; the training loss is their weighted sum.

    `reduction` "sums" is the paper's form: both losses are plain sums over all predictors of all scales, divided by the
    number of frames.

    "means" is our deviation. For each scale, L_ciou is the mean over the positive predictors, or 0 without positive
    predictors. L_obj is the sum of the binary cross-entropy of the objectness over positive and (times lambda_noobj)
    negative predictors, divided by the number of all predictors of the scale. The scales are averaged with weights
    1 / stride. With means, both losses train with the paper's weights 0.05 and 1. In a plain sum the coarse scales
    hardly count, because their craters are a hundred times rarer; the means give them more weight.

    No tensor shape depends on tensor values, so the CPU never waits for the GPU.

    The objectness target of a positive predictor is 1 (`hard`, YOLOv3) or the IoU of its box with its label (`iou`).
    With `iou` the score measures how well a box fits, and suppression keeps the best box on a crater.
    """
    box, confidence = outputs[0].new_zeros(()), outputs[0].new_zeros(())
    total = sum(1 / stride for stride in strides)
    for raw, own_anchors, stride, assignment in zip(outputs, anchors, strides, targets, strict=True):
        _, anchor, row, column = assignment.predictors
        flat = flat_predictors(assignment.predictors, raw.shape[:4])
        chosen, cells = raw.flatten(0, 3)[flat].float(), torch.stack([column, row], 1)
        boxes, labels = decode(chosen, cells, own_anchors[anchor], stride), assignment.boxes
        counted = None if assignment.counted is None else assignment.counted.float()
        n_labels = max(len(labels), 1) if counted is None else counted.sum().clamp(min=1)
        sums = settings.reduction == "sums"
        # Divisors of the sums over the predictors of this scale.
        of_boxes, of_scores = (
            (len(raw), len(raw)) if sums else (n_labels * total * stride, raw[..., 4].numel() * total * stride)
        )
        # An empty sum keeps the graph, so that a batch of empty frames stays differentiable.
        losses = ciou_loss(boxes, labels, settings.aspect)
        box = box + (losses if counted is None else losses * counted).sum() / of_boxes
        positive = assignment.positive
        weight = torch.where(positive, 1.0, settings.lambda_noobj * (~assignment.ignored))
        target = positive.float()
        if settings.objectness == "iou":
            # If two labels share a predictor, use the larger IoU.
            overlap = iou(boxes.detach(), labels)
            overlap = overlap if counted is None else overlap * counted
            target = torch.zeros_like(target).view(-1).scatter_reduce(0, flat, overlap, "amax").view_as(target)
        logits = raw[..., 4].float()
        entropy = F.binary_cross_entropy_with_logits(logits, target, weight, reduction="sum")
        confidence = confidence + entropy / of_scores
    return box, confidence
