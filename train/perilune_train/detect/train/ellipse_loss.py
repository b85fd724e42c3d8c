"""Loss of the ellipse outputs of the detector: correlation of the ellipse in the box, and standard deviations."""

import torch
from torch import Tensor

from perilune_train.detect.config import LossSettings
from perilune_train.detect.data.assign import Targets, flat_predictors
from perilune_train.models.boxes import iou
from perilune_train.models.ellipse import decode_correlation, decode_sigmas, semi_axes
from perilune_train.models.yolo import OUTPUTS, decode

_MIN_IOU = 0.5
"""Predictors whose boxes overlap the label less do not train the standard deviations, which describe detections that
match a label."""


def ellipse_loss(
    outputs: list[Tensor], targets: Targets, anchors: Tensor, strides: tuple[int, ...], settings: LossSettings
) -> tuple[Tensor, Tensor]:
    """L_ellipse and L_sigma of raw outputs (N, 3, h, w, 10) per scale, averaged over positive predictors as L_ciou.

    L_ellipse is the squared distance between the predicted correlation and the label's. The smooth L1 distance did not
    work: most craters are seen from almost above, so its minimum for an uncertain network is a correlation of 0.

    L_sigma is the Gaussian negative log-likelihood, without its constant, of four errors: of the centre's x and y, and
    of the semi-major and the semi-minor axis, pixels. It is 0 if the box and the label box have an IoU below 0.5. The
    errors carry no gradient, so L_sigma trains only the standard deviations and the layers before them, and boxes are
    trained by L_ciou alone. At the minimum of L_sigma, the mean of (error / standard deviation)^2 is 1.

    No tensor shape depends on tensor values, so the CPU never waits for the GPU.
    """
    shape_loss, sigma_loss = outputs[0].new_zeros(()), outputs[0].new_zeros(())
    total = sum(1 / stride for stride in strides)
    for raw, own_anchors, stride, assignment in zip(outputs, anchors, strides, targets, strict=True):
        assert assignment.correlations is not None
        _, anchor, row, column = assignment.predictors
        chosen = raw.flatten(0, 3)[flat_predictors(assignment.predictors, raw.shape[:4])].float()
        shape, labels, true_correlations = chosen[:, OUTPUTS:], assignment.boxes, assignment.correlations
        boxes = decode(chosen, torch.stack([column, row], 1), own_anchors[anchor], stride).detach()
        correlations = decode_correlation(shape)
        distances = (correlations - true_correlations).square()
        centre_error = (boxes[:, :2] + boxes[:, 2:] - labels[:, :2] - labels[:, 2:]) / 2
        axis_error = semi_axes(boxes, correlations.detach()) - semi_axes(labels, true_correlations)
        sigmas = decode_sigmas(shape, boxes)
        likelihood = (torch.cat([centre_error, axis_error], 1) / sigmas).square() / 2 + sigmas.log()
        counted = torch.ones_like(distances) if assignment.counted is None else assignment.counted.float()
        divisor = len(raw) if settings.reduction == "sums" else counted.sum().clamp(min=1) * total * stride
        shape_loss = shape_loss + (distances * counted).sum() / divisor
        sigma_loss = sigma_loss + (likelihood.sum(1) * (iou(boxes, labels) >= _MIN_IOU) * counted).sum() / divisor
    return shape_loss, sigma_loss
