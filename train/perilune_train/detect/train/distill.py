"""A small detector learns from a large one, beside the labels (Hinton et al. 2015, arXiv 1503.02531)."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from perilune_train.detect.train.loss import ciou_loss
from perilune_train.models.yolo import YOLOv3, decode_grid

_SURE = 0.1
"""Boxes are learnt from predictors whose score by the teacher is at least this: the others' mean nothing."""


@dataclass(frozen=True)
class Teacher:
    """A trained network. Held by a plain class, so that it is no part of the student's weights or checkpoints."""

    network: YOLOv3
    """In evaluation mode."""

    @torch.no_grad()
    def __call__(self, images: Tensor) -> list[Tensor]:
        """Its raw outputs for a batch (N, C, H, W), as `YOLOv3.forward` gives them."""
        return self.network.to(images.device)(images)


def distill_loss(
    student: list[Tensor], teacher: list[Tensor], anchors: Tensor, strides: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """How far a student's raw outputs (N, 3, h, w, 5) per scale are from its teacher's: of boxes, of objectness.

    Boxes: the mean CIoU loss against the teacher's boxes, over predictors that the teacher gives a score of at least
    0.1, weighted by that score. Objectness: the mean over all predictors of the Kullback-Leibler divergence of the
    student's score from the teacher's. Both are 0 for equal outputs, and the teacher gets no gradient. Both networks
    have the same anchors (3, 3, 2) and strides, so that each predictor has one of the teacher beside it.
    """
    box, weights, confidence, predictors = student[0].new_zeros(()), student[0].new_zeros(()), [], 0
    for raw, told, prior, stride in zip(student, teacher, anchors, strides, strict=True):
        told = told.detach().float()
        score = told[..., 4].sigmoid()
        sure = score >= _SURE
        own, wanted = (decode_grid(part.float(), prior, stride)[sure] for part in (raw, told))
        box = box + (score[sure] * ciou_loss(own, wanted, "standard")).sum()
        weights = weights + score[sure].sum()
        # Cross-entropy less the teacher's own entropy.
        logits = told[..., 4]
        confidence.append(F.binary_cross_entropy_with_logits(raw[..., 4].float(), score, reduction="sum"))
        confidence.append(-F.binary_cross_entropy_with_logits(logits, score, reduction="sum"))
        predictors += score.numel()
    return box / weights.clamp(min=1.0), torch.stack(confidence).sum() / predictors
