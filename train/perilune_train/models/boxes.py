"""Intersection over union in torch. A box is x0, y0, x1, y1 in pixels. NumPy version: detect/evaluate/boxes.py."""

import torch
from torch import Tensor

_MIN_UNION = 1e-7
"""Lower limit of the union, square pixels, so that two empty boxes have an IoU of 0."""


def iou(first: Tensor, second: Tensor) -> Tensor:
    """Differentiable intersection over union (...) of two sets of boxes (..., 4), which are broadcast."""
    areas = _area(first) + _area(second)
    sides = torch.minimum(first[..., 2:], second[..., 2:]) - torch.maximum(first[..., :2], second[..., :2])
    intersection = _product(sides.clamp(min=0))
    return intersection / (areas - intersection).clamp(min=_MIN_UNION)


def _area(boxes: Tensor) -> Tensor:
    return _product((boxes[..., 2:] - boxes[..., :2]).clamp(min=0))


def _product(sides: Tensor) -> Tensor:
    # The gradient of `prod` counts zeros, for which the process waits for the GPU.
    return sides[..., 0] * sides[..., 1]
