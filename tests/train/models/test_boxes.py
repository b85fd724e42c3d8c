"""The torch form of the intersection over union against the NumPy form."""

import numpy as np
import pytest
import torch

from perilune_train.detect.evaluate.boxes import iou_matrix
from perilune_train.models.boxes import iou


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_both_forms_agree(dtype, tolerance):
    rng = np.random.default_rng(0)
    corner = rng.uniform(0, 40, (60, 2))
    boxes = torch.tensor(np.concatenate([corner, corner + rng.uniform(0.1, 30, (60, 2))], axis=1), dtype=dtype)
    boxes[7] = boxes[3]
    boxes[9, 2:] = boxes[9, :2]
    expected = iou_matrix(boxes[:40], boxes[20:])
    assert (expected > 0.5).any() and (expected == 0).any()
    np.testing.assert_allclose(iou(boxes[:40, None], boxes[None, 20:]), expected, atol=tolerance)
    pairs = iou_matrix(boxes[:30], boxes[30:]).diagonal()
    np.testing.assert_allclose(iou(boxes[:30], boxes[30:]), pairs, atol=tolerance)


def test_empty_boxes_overlap_nothing_and_have_finite_gradients():
    boxes = torch.tensor([[1.0, 1, 1, 1], [3, 3, 2, 2], [0, 0, 4, 4]], requires_grad=True)
    overlap = iou(boxes[:2], boxes[[0, 2]])
    overlap.sum().backward()
    assert overlap.tolist() == [0, 0]
    assert boxes.grad is not None and boxes.grad.isfinite().all()
