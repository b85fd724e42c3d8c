"""Loss of the ellipse outputs of the detector: correlation of the ellipse in the box, and standard deviations."""

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.config import LossSettings
from perilune_train.detect.data.assign import Targets, flat_predictors
from perilune_train.models.boxes import iou
from perilune_train.models.ellipse import decode_correlation, decode_sigmas, semi_axes
from perilune_train.models.yolo import OUTPUTS, decode

_MIN_IOU = 0.5
"""Predictors whose boxes overlap the label less do not train the standard deviations, which describe detections that
match a label."""
_SMOOTH_CORRELATION = 0.1
"""Error of a correlation at which its loss changes from quadratic to linear."""


def ellipse_loss(
    outputs: list[Tensor], targets: Targets, anchors: Tensor, strides: tuple[int, ...], settings: LossSettings
) -> Tensor:
    """Loss of raw outputs (N, 3, h, w, 10) per scale, over positive predictors, averaged as L_ciou.

    The loss of a predictor is the sum of two parts:

    - the smooth L1 distance between its correlation and the label's
    - if its box has an IoU of at least 0.5 with the label box: the Gaussian negative log-likelihood, without its
      constant, of four errors: of the centre's x and y, and of the semi-major and the semi-minor axis, pixels

    The errors carry no gradient, so the likelihood trains only the standard deviations (and the layers before them).
    Boxes are trained only by L_ciou, and correlations only by the first part. At the minimum, the mean of (error /
    standard deviation)^2 is 1.

    No tensor shape depends on tensor values, so the CPU never waits for the GPU.
    """
    loss, total = outputs[0].new_zeros(()), sum(1 / stride for stride in strides)
    for raw, own_anchors, stride, assignment in zip(outputs, anchors, strides, targets, strict=True):
        assert assignment.correlations is not None
        _, anchor, row, column = assignment.predictors
        chosen = raw.flatten(0, 3)[flat_predictors(assignment.predictors, raw.shape[:4])].float()
        shape, labels, true_correlations = chosen[:, OUTPUTS:], assignment.boxes, assignment.correlations
        boxes = decode(chosen, torch.stack([column, row], 1), own_anchors[anchor], stride).detach()
        correlations = decode_correlation(shape)
        losses = F.smooth_l1_loss(correlations, true_correlations, reduction="none", beta=_SMOOTH_CORRELATION)
        centre_error = (boxes[:, :2] + boxes[:, 2:] - labels[:, :2] - labels[:, 2:]) / 2
        axis_error = semi_axes(boxes, correlations.detach()) - semi_axes(labels, true_correlations)
        sigmas = decode_sigmas(shape, boxes)
        likelihood = (torch.cat([centre_error, axis_error], 1) / sigmas).square() / 2 + sigmas.log()
        losses = losses + likelihood.sum(1) * (iou(boxes, labels) >= _MIN_IOU)
        counted = None if assignment.counted is None else assignment.counted.float()
        n_labels = max(len(labels), 1) if counted is None else counted.sum().clamp(min=1)
        divisor = len(raw) if settings.reduction == "sums" else n_labels * total * stride
        loss = loss + (losses if counted is None else losses * counted).sum() / divisor
    return loss
