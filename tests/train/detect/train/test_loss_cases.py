"""The loss by hand where it is easily wrong: no area, no labels, many labels, ignored labels, weights."""

import math

import pytest
import torch

from perilune_train.detect.config import LossSettings
from perilune_train.detect.data.assign import BatchLabels, assign
from perilune_train.detect.train.loss import ciou_loss, detection_loss

ANCHORS = torch.tensor([[[8.0, 8.0], [16.0, 16.0], [30.0, 30.0]]])
LN2 = math.log(2)
"""Cross-entropy of a raw objectness of 0, whatever its target."""


def labels(*boxes, frame=None, selected=None):
    count = len(boxes)
    return BatchLabels(
        torch.tensor(boxes, dtype=torch.float32).view(-1, 4),
        torch.tensor(frame or [0] * count, dtype=torch.long),
        torch.tensor(selected or [True] * count, dtype=torch.bool),
    )


def losses(raw, given, ratio=1.5, stride=8, **settings):
    chosen = LossSettings(**{"aspect": "circular", "lambda_noobj": 1.0, **settings})
    frames, _, rows, columns, _ = raw.shape
    targets = assign(given, ANCHORS, (stride,), [(frames, rows, columns)], ratio)
    return detection_loss([raw], targets, ANCHORS, (stride,), chosen)


def raw_zero(frames=1, rows=4, columns=4):
    return torch.zeros(frames, 3, rows, columns, 5, requires_grad=True)


@pytest.mark.parametrize(
    ("predicted", "label", "aspect", "expected"),
    [
        # 6 x 4 and 6 x 8, overlap 4 x 3: IoU = 12 / (24 + 48 - 12) = 0.2. Centres (3, 2), (5, 5): 13; around them
        # 8 x 9: 145; 13 / 145 = 0.089655. Circular: (atan 1 - atan 1.5)^2 = (0.785398 - 0.982794)^2 = 0.038965,
        # v = 4 / pi^2 x 0.038965 = 0.015792, alpha = v / (0.8 + v) = 0.019358, alpha v = 0.000306.
        ([0, 0, 6, 4], [2, 1, 8, 9], "circular", 0.8 + 0.089655 + 0.000306),
        # Standard: (atan 0.75 - atan 1.5)^2 = (0.643501 - 0.982794)^2 = 0.115119, v = 0.046656, alpha = 0.055106.
        ([0, 0, 6, 4], [2, 1, 8, 9], "standard", 0.8 + 0.089655 + 0.002571),
        # Apart: IoU 0; centres (1, 1), (7, 9): 36 + 64; around them 8 x 10: 164. Squares have no aspect term.
        ([0, 0, 2, 2], [6, 8, 8, 10], "circular", 1 + 100 / 164),
        ([0, 0, 2, 2], [6, 8, 8, 10], "standard", 1 + 100 / 164),
        # A point in the middle of its label counts as round: only the IoU, 0, costs.
        ([5, 5, 5, 5], [0, 0, 10, 10], "circular", 1.0),
        ([5, 5, 5, 5], [0, 0, 10, 10], "standard", 1.0),
        # An upright line: atan 0 = 0, v = 4 / pi^2 (pi / 4)^2 = 1/4, alpha = 0.25 / 1.25 = 0.2, alpha v = 0.05.
        ([5, 0, 5, 10], [0, 0, 10, 10], "circular", 1.05),
        ([5, 0, 5, 10], [0, 0, 10, 10], "standard", 1.05),
        # A label that is a line: standard v = 4 / pi^2 (0 - pi / 4)^2 too, the paper's prior knows no label.
        ([0, 0, 10, 10], [5, 0, 5, 10], "standard", 1.05),
        ([0, 0, 10, 10], [5, 0, 5, 10], "circular", 1.0),
        # A point on the label's corner: centres 2 px apart in x and y, 4 x 4 around them.
        ([4, 4, 4, 4], [0, 0, 4, 4], "circular", 1 + 8 / 32),
    ],
)
def test_ciou_by_hand(predicted, label, aspect, expected):
    boxes = (torch.tensor([box], dtype=torch.float32) for box in (predicted, label))
    assert ciou_loss(*boxes, aspect).item() == pytest.approx(expected, abs=2e-6)


def test_a_label_without_area_costs_and_teaches_finitely():
    raw = raw_zero()
    box, confidence = losses(raw, labels([12, 12, 12, 12]))
    # Predicted 8 x 8 about the own cell's centre (12, 12): loss 1; about the cells beside it, 8 px off: the corners
    # of both span 12 x 8, so 64 / (144 + 64).
    assert box.item() == pytest.approx((1 + 2 * (1 + 64 / 208)) / 3, abs=1e-5)
    assert confidence.item() == pytest.approx(LN2, rel=1e-5)
    (box + confidence).backward()
    assert raw.grad.isfinite().all()


@pytest.mark.parametrize("empty", [0, 1])
def test_a_frame_without_labels_beside_one_with(empty):
    raw = raw_zero(frames=2)
    box, confidence = losses(raw, labels([8, 8, 16, 16], frame=[1 - empty]))
    # As for the single frame of test_loss.py, but over twice as many predictors.
    assert box.item() == pytest.approx(2 * (1 + 64 / 320) / 3, abs=1e-5)
    assert confidence.item() == pytest.approx(LN2, rel=1e-5)
    (box + confidence).backward()
    # From the empty frame the network learns only that it is empty: s(0) / 96 at every predictor.
    assert raw.grad[empty, ..., :4].abs().max() == 0
    torch.testing.assert_close(raw.grad[empty, ..., 4], torch.full((3, 4, 4), 0.5 / 96))
    assert raw.grad[1 - empty, 0, 1, 1, 4] < 0
    assert raw.grad[1 - empty, ..., :4].abs().max() > 0


def test_a_batch_without_any_label():
    raw = raw_zero(frames=3)
    box, confidence = losses(raw, labels(), lambda_noobj=0.25)
    assert box.item() == 0 and confidence.item() == pytest.approx(0.25 * LN2, rel=1e-5)
    (box + confidence).backward()
    assert raw.grad[..., :4].abs().max() == 0
    torch.testing.assert_close(raw.grad[..., 4], torch.full((3, 3, 4, 4), 0.25 * 0.5 / (3 * 48)))


def test_500_craters_in_one_frame_by_hand():
    # 25 x 20 craters of 8 px, centres in the middle of every third cell of 4 px.
    boxes = [[12 * k + 2, 12 * j + 2, 12 * k + 10, 12 * j + 10] for k in range(25) for j in range(20)]
    given = labels(*boxes)
    raw = raw_zero(rows=64, columns=80)
    made = assign(given, ANCHORS, (4,), [(1, 64, 80)], 1.5)[0]
    assert len(made.boxes) == int(made.positive.sum()) == 1500
    assert torch.unique(made.boxes, dim=0, return_counts=True)[1].tolist() == [3] * 500
    box, confidence = losses(raw, given, stride=4)
    # The own cell's box fits. Those of the cells beside it are 4 px off: IoU 32 / 96, distance 16 / (12^2 + 8^2).
    assert box.item() == pytest.approx(2 * (1 - 1 / 3 + 16 / 208) / 3, abs=1e-5)
    assert confidence.item() == pytest.approx(LN2, rel=1e-5)
    (box + confidence).backward()
    assert raw.grad.isfinite().all()


def test_500_craters_on_one_spot():
    corner = 12 + torch.rand(500, 2, generator=torch.Generator().manual_seed(0))
    targets = labels(*torch.cat([corner - 4, corner + 4], 1).tolist())
    raw = raw_zero()
    box, confidence = losses(raw, targets)
    assert torch.isfinite(box) and 0 < confidence.item() <= LN2 * (1 + 1e-5)
    (box + confidence).backward()
    assert raw.grad.isfinite().all()


def test_no_gradient_at_predictors_on_ignored_craters():
    raw = raw_zero()
    # 16 px about (16, 16): the four cells around it, 4 px off, within the reach of 16 / 4 + 8 / 2 = 8 px.
    box, confidence = losses(raw, labels([8, 8, 24, 24], selected=[False]))
    (box + confidence).backward()
    ignored = torch.zeros(3, 4, 4, dtype=torch.bool)
    ignored[1, 1:3, 1:3] = True
    assert box.item() == 0
    assert (raw.grad[0, ..., 4] == 0).equal(ignored)
    assert raw.grad[..., :4].abs().max() == 0


def test_a_wanted_crater_is_learned_where_an_ignored_one_lies_on_it():
    raw = raw_zero()
    one = [8, 8, 16, 16]
    box, confidence = losses(raw, labels(one, one, selected=[True, False]))
    (box + confidence).backward()
    assert box.item() == pytest.approx(2 * (1 + 64 / 320) / 3, abs=1e-5)
    # Its box fits (IoU 1), so that its objectness is drawn up to 1: (s(0) - 1) / 48.
    assert raw.grad[0, 0, 1, 1, 4].item() == pytest.approx(-0.5 / 48, rel=1e-5)


@pytest.mark.parametrize("weight", [0.5, 1.0, 3.0])
def test_lambda_noobj_weighs_the_empty_predictors_alone(weight):
    one = labels([8, 8, 16, 16])
    raw = raw_zero()
    _, confidence = losses(raw, one, lambda_noobj=weight)
    # 3 of 48 predictors answer for the label.
    assert confidence.item() == pytest.approx((3 + weight * 45) * LN2 / 48, rel=1e-5)
    confidence.backward()
    assert raw.grad[0, 0, 1, 1, 4].item() == pytest.approx(-0.5 / 48, rel=1e-5)
    assert raw.grad[0, 2, 3, 3, 4].item() == pytest.approx(weight * 0.5 / 48, rel=1e-5)
