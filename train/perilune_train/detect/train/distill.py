"""Distillation: a small detector learns from a large one and from the labels.

Source: Hinton et al. 2015, arXiv 1503.02531.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.train.loss import ciou_loss
from perilune_train.models.yolo import YOLOv3, decode_grid

_MIN_TEACHER_SCORE = 0.1
"""Minimum teacher score of the predictors whose boxes are learned; boxes of lower scores are meaningless."""


@dataclass(frozen=True)
class Teacher:
    """A trained network. Not an nn.Module: the student's weights and checkpoints must not contain it."""

    network: YOLOv3
    """The network, in evaluation mode."""

    @torch.no_grad()
    def __call__(self, images: Tensor) -> list[Tensor]:
        """Raw outputs for a batch (N, C, H, W), as from `YOLOv3.forward`."""
        return self.network.to(images.device)(images)


def distill_loss(
    student: list[Tensor], teacher: list[Tensor], anchors: Tensor, strides: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Distillation losses, of boxes and of objectness, from raw outputs (N, 3, h, w, 5) per scale.

    Boxes: mean CIoU loss against the teacher's boxes, over predictors with a teacher score of at least 0.1, weighted by
    that score. Objectness: mean over all predictors of the Kullback-Leibler divergence of the student's score from the
    teacher's. Both losses are 0 for equal outputs. The teacher gets no gradient. Both networks must have equal anchors
    (3, 3, 2) and strides, so that their predictors correspond.

    No tensor shape depends on tensor values, so the CPU never waits for the GPU.
    """
    box, weights, confidence, predictors = student[0].new_zeros(()), student[0].new_zeros(()), [], 0
    for raw, target, own_anchors, stride in zip(student, teacher, anchors, strides, strict=True):
        target = target.detach().float()
        score = target[..., 4].sigmoid()
        weight = torch.where(score >= _MIN_TEACHER_SCORE, score, 0.0)
        predicted, expected = (decode_grid(part.float(), own_anchors, stride) for part in (raw, target))
        losses = ciou_loss(predicted.flatten(0, 3), expected.flatten(0, 3), "standard")
        box = box + (weight.flatten() * losses).sum()
        weights = weights + weight.sum()
        # Kullback-Leibler divergence: cross-entropy minus the teacher's entropy.
        logits = target[..., 4]
        confidence.append(F.binary_cross_entropy_with_logits(raw[..., 4].float(), score, reduction="sum"))
        confidence.append(-F.binary_cross_entropy_with_logits(logits, score, reduction="sum"))
        predictors += score.numel()
    return box / weights.clamp(min=1.0), torch.stack(confidence).sum() / predictors
