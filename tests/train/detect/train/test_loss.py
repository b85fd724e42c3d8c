"""CIoU and the loss, by hand."""

import math

import pytest
import torch
from torch._subclasses.fake_tensor import DynamicOutputShapeException, FakeTensorMode

from perilune_train.detect.config import LossSettings
from perilune_train.detect.data.assign import Assignment, BatchLabels, assign
from perilune_train.detect.train.loss import ciou_loss, detection_loss


def test_equal_circles_cost_nothing():
    box = torch.tensor([[1.0, 2.0, 7.0, 8.0]])
    torch.testing.assert_close(ciou_loss(box, box), torch.zeros(1), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("aspect", "ratio_label"), [("circular", 1.0), ("standard", 0.5)])
def test_by_hand(aspect, ratio_label):
    predicted, label = torch.tensor([[0.0, 0.0, 4.0, 2.0]]), torch.tensor([[0.0, 0.0, 2.0, 4.0]])
    iou = 4 / 12
    distance = (1 + 1) / (16 + 16)
    v = 4 / math.pi**2 * (math.atan(ratio_label) - math.atan(2.0)) ** 2
    expected = 1 - iou + distance + v / (1 - iou + v) * v
    assert ciou_loss(predicted, label, aspect).item() == pytest.approx(expected, abs=1e-5)


def test_circular_prior_pulls_towards_a_circle_where_the_label_is_an_ellipse():
    ellipse = torch.tensor([[0.0, 0.0, 10.0, 5.0]])
    assert ciou_loss(ellipse, ellipse, "standard").item() == pytest.approx(0, abs=1e-6)
    # IoU is 1 here, so alpha = v / v = 1 and the aspect term stands alone.
    v = 4 / math.pi**2 * (math.pi / 4 - math.atan(2.0)) ** 2
    assert ciou_loss(ellipse, ellipse, "circular").item() == pytest.approx(v, rel=1e-3)


def test_alpha_carries_no_gradient():
    box = torch.tensor([[0.0, 0.0, 6.0, 4.0]], requires_grad=True)
    label = torch.tensor([[0.0, 0.0, 5.0, 5.0]])
    ciou_loss(box, label).sum().backward()
    w, h = torch.tensor(6.0, requires_grad=True), torch.tensor(4.0)
    iou = 20 / (w * h + 25 - 20)
    centre = ((w - 5) / 2) ** 2 + ((h - 5) / 2) ** 2
    v = 4 / math.pi**2 * (math.pi / 4 - torch.atan(w / h)) ** 2
    alpha = (v / (1 - iou + v)).item()
    (1 - iou + centre / (w**2 + 25) + alpha * v).backward()
    assert box.grad[0, 2].item() == pytest.approx(w.grad.item(), rel=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_degenerate_boxes_are_finite_in_every_type(dtype):
    box = torch.tensor([[0, 0, 0, 0], [5, 5, 5, 9], [0, 0, 3, 3]], dtype=dtype, requires_grad=True)
    loss = ciou_loss(box, torch.tensor([[0, 0, 0, 0], [0, 0, 0, 0], [9, 9, 9, 9]], dtype=dtype))
    loss.sum().backward()
    assert loss.dtype == torch.float32
    assert loss.isfinite().all() and box.grad.isfinite().all()
    assert ciou_loss(box[:0], box[:0]).shape == (0,)


def anchors_and_output():
    return torch.tensor([[[8.0, 8.0], [16.0, 16.0], [30.0, 30.0]]]), torch.zeros(1, 3, 4, 4, 5)


def loss(raw, labels, anchors, ratio, settings):
    targets = assign(labels, anchors, (8,), [(1, 4, 4)], ratio)
    return detection_loss([raw], targets, anchors, (8,), settings)


def test_loss_by_hand():
    anchors, raw = anchors_and_output()
    label = BatchLabels(torch.tensor([[8.0, 8.0, 16.0, 16.0]]), torch.tensor([0]), torch.tensor([True]))
    box, confidence = loss(raw, label, anchors, 1.5, LossSettings(lambda_noobj=0.5))
    # Centre (12, 12): cell (1, 1) exactly, its neighbours right and below 8 px off; 3 of 48 predictors positive.
    # Shifted boxes: IoU 0, distance 64 / (256 + 64). Reach of the ignored ones: 8 / 4 + 4 = 6 px, only cell (1, 1).
    assert box.item() == pytest.approx((0 + 2 * (1 + 64 / 320)) / 3, abs=1e-5)
    assert confidence.item() == pytest.approx((3 + 0.5 * 45) * math.log(2) / 48, rel=1e-5)


def test_plain_sums_by_hand():
    """The case above on two scales of two frames, the label in the first frame of each."""
    anchors, _ = anchors_and_output()
    label = BatchLabels(torch.tensor([[8.0, 8.0, 16.0, 16.0]]), torch.tensor([0]), torch.tensor([True]))
    both = torch.cat([anchors, anchors])
    targets = assign(label, both, (8, 8), [(2, 4, 4)] * 2, 1.5)
    settings = LossSettings(lambda_noobj=0.5, reduction="sums")
    box, confidence = detection_loss([torch.zeros(2, 3, 4, 4, 5)] * 2, targets, both, (8, 8), settings)
    assert box.item() == pytest.approx(2 * (0 + 2 * (1 + 64 / 320)) / 2, abs=1e-5)
    assert confidence.item() == pytest.approx(2 * (3 + 0.5 * 93) * math.log(2) / 2, rel=1e-5)


def test_ignored_label_takes_its_predictors_out_of_the_loss():
    anchors, raw = anchors_and_output()
    boxes = torch.tensor([[8.0, 8.0, 16.0, 16.0]])
    none = BatchLabels(boxes[:0], torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.bool))
    ignored = BatchLabels(boxes, torch.tensor([0]), torch.tensor([False]))
    full = loss(raw, none, anchors, 1.5, LossSettings())[1]
    less = loss(raw, ignored, anchors, 1.5, LossSettings())[1]
    assert full.item() == pytest.approx(math.log(2), rel=1e-5)
    assert less.item() == pytest.approx(47 / 48 * math.log(2), rel=1e-5)


def test_empty_frame_has_a_gradient():
    anchors, raw = anchors_and_output()
    raw.requires_grad_()
    none = BatchLabels(torch.zeros(0, 4), torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.bool))
    box, confidence = loss(raw, none, anchors, 2.0, LossSettings())
    (box + confidence).backward()
    assert box.item() == 0
    assert raw.grad[..., 4].min() > 0 and raw.grad[..., :4].abs().max() == 0


@pytest.mark.parametrize("objectness", ["hard", "iou"])
def test_no_step_of_the_loss_needs_a_value(objectness):
    """A GPU would have to be waited for. Fake tensors have no values: an operation that needs one raises an error."""
    anchors = torch.tensor([[[8.0, 8.0], [16.0, 16.0], [30.0, 30.0]]])
    boxes = torch.tensor([[8.0, 8.0, 16.0, 16.0], [4.0, 4.0, 20.0, 20.0], [0.0, 0.0, 30.0, 30.0]])
    labels = BatchLabels(boxes, torch.tensor([0, 0, 1]), torch.tensor([True, True, False]))
    targets = assign(labels, anchors, (8,), [(2, 4, 4)], 1.5)
    assert targets[0].predictors.shape[1] > 3 and targets[0].ignored.any()
    with FakeTensorMode() as fake:
        raw = torch.zeros(2, 3, 4, 4, 5, requires_grad=True)
        parts = {name: fake.from_tensor(part) for name, part in vars(targets[0]).items() if part is not None}
        given = [Assignment(**parts)]
        loss = sum(detection_loss([raw], given, fake.from_tensor(anchors), (8,), LossSettings(objectness=objectness)))
        loss.backward()
        assert raw.grad.shape == raw.shape
        # The assignment itself depends on values, so the loader does it.
        fake_labels = BatchLabels(*(fake.from_tensor(part) for part in (labels.boxes, labels.frame, labels.selected)))
        with pytest.raises(DynamicOutputShapeException):
            assign(fake_labels, fake.from_tensor(anchors), (8,), [(2, 4, 4)], 1.5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_is_not_waited_for():
    anchors, raw = anchors_and_output()
    label = BatchLabels(torch.tensor([[8.0, 8.0, 16.0, 16.0]]), torch.tensor([0]), torch.tensor([True]))
    targets, device = assign(label, anchors, (8,), [(1, 4, 4)], 1.5), torch.device("cuda")
    pinned = [part.pin_memory() for part in targets]
    raw, anchors = raw.to(device).requires_grad_(), anchors.to(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        box, confidence = detection_loss([raw], [part.to(device) for part in pinned], anchors, (8,), LossSettings())
        (box + confidence).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
