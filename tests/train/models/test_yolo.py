"""Heads, decoding, prior."""

import math

import pytest
import torch

from perilune_train.models.yolo import YOLOv3, decode, decode_grid


def test_decode_by_hand():
    raw = torch.tensor([[0.0, 0.0, 0.0, math.log(2), 5.0]])
    box = decode(raw, torch.tensor([[3, 1]]), torch.tensor([[6.0, 10.0]]), stride=8)
    # s(0) = 0.5 puts the centre in the middle of cell (3, 1): (28, 12); width 6, height 2 * 10.
    torch.testing.assert_close(box, torch.tensor([[25.0, 2.0, 31.0, 22.0]]))
    far = torch.tensor([[20.0, -20.0, 0.0, 0.0]])
    box = decode(far, torch.tensor([[3, 1]]), torch.tensor([[6.0, 10.0]]), stride=8)
    # The centre reaches half a cell beyond the cell and no further: (4.5, 0.5) cells.
    torch.testing.assert_close(box, torch.tensor([[33.0, -1.0, 39.0, 9.0]]))


def test_grid_has_columns_along_x():
    boxes = decode_grid(torch.zeros(1, 3, 2, 4, 5), torch.full((3, 2), 2.0), stride=4)
    torch.testing.assert_close(boxes[0, 0, 1, 2], torch.tensor([9.0, 5.0, 11.0, 7.0]))


@pytest.mark.parametrize(("strides", "parameters"), [((8, 16, 32), 61_523_734), ((4, 8, 16), None)])
def test_shapes_and_size(strides, parameters):
    network = YOLOv3(None, 1, 0.125, "cbam_identity", strides)
    outputs = network(torch.zeros(2, 1, 64, 96))
    assert [o.shape for o in outputs] == [(2, 3, 64 // s, 96 // s, 5) for s in strides]
    if parameters is not None:
        with torch.device("meta"):
            full = YOLOv3(None, 3, 1.0, "none", strides)
        # The COCO network has 85 outputs an anchor instead of 5, on head inputs of 256, 512 and 1024 channels.
        coco = sum(p.numel() for p in full.parameters()) + 3 * 80 * (256 + 512 + 1024 + 3)
        assert coco == 61_949_149


def test_objectness_starts_at_its_prior_and_boxes_at_their_anchors():
    anchors = torch.tensor([[[4.0, 4.0]] * 3, [[8.0, 8.0]] * 3, [[16.0, 16.0]] * 3])
    boxes, scores = YOLOv3(anchors, 1, 0.125, strides=(4, 8, 16)).eval().detect(torch.zeros(1, 1, 32, 32))
    assert boxes.shape == (1, 3 * (64 + 16 + 4), 4)
    torch.testing.assert_close(scores, torch.full_like(scores, 0.01), atol=2e-3, rtol=0)
    width = (boxes[0, :, 2] - boxes[0, :, 0])[: 3 * 64]
    torch.testing.assert_close(width, torch.full_like(width, 4.0), atol=0.1, rtol=0)


def test_other_strides_are_refused():
    with pytest.raises(ValueError, match="strides are"):
        YOLOv3(strides=(2, 4, 8))


def test_ellipse_outputs_leave_the_others_as_they_are():
    """Equal seeds give equal weights and outputs, with and without ellipses."""
    networks = []
    for ellipses in (False, True):
        torch.manual_seed(4)
        networks.append(YOLOv3(None, 1, 0.125, "cbam_identity", (4, 8, 16), ellipses).eval())
    plain, elliptic = networks
    images = torch.randn(2, 1, 64, 96, generator=torch.Generator().manual_seed(5))
    for own, other in zip(plain(images), elliptic(images), strict=True):
        assert other.shape == (*own.shape[:4], 10) and torch.equal(other[..., :5], own)
    boxes, scores, shapes = elliptic.detect_ellipses(images)
    torch.testing.assert_close((boxes, scores), plain.detect(images))
    assert plain.detect_ellipses(images)[2] is None
    assert shapes.shape == (*scores.shape, 5)
    # Nearly circles at first, with deviations of about exp(-2) sqrt(d) pixels.
    side = (boxes[..., 2:] - boxes[..., :2]).prod(-1).sqrt()
    assert shapes[..., 0].abs().max() < 0.3
    typical = math.exp(-2) * side.sqrt()[..., None].expand(-1, -1, 4)
    torch.testing.assert_close(shapes[..., 1:], typical, rtol=0.3, atol=0)
