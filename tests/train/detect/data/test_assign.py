"""Assignment by hand: which cells answer for which label."""

import torch

from perilune_train.detect.data.assign import BatchLabels, assign, matching_anchors

ANCHORS = torch.tensor([[[4.0, 4.0], [8.0, 8.0], [16.0, 16.0]], [[32.0, 32.0], [64.0, 64.0], [100.0, 100.0]]])
SHAPES = [(2, 16, 16), (2, 8, 8)]


def labels(*boxes, frame=None, selected=None):
    count = len(boxes)
    return BatchLabels(
        torch.tensor(boxes).view(-1, 4),
        torch.tensor(frame or [0] * count, dtype=torch.long),
        torch.tensor(selected or [True] * count, dtype=torch.bool),
    )


def test_anchors_within_the_ratio_take_part():
    boxes = torch.tensor([[0.0, 0.0, 6.0, 6.0], [0.0, 0.0, 500.0, 500.0], [0.0, 0.0, 0.0, 0.0]])
    matches = matching_anchors(boxes, ANCHORS.flatten(0, 1), 2.0)
    assert matches[0].tolist() == [True, True, False, False, False, False]
    assert matches[1].tolist() == [False] * 5 + [True]
    assert matches[2].sum() == 1


def test_centre_cell_and_two_neighbours():
    # Centre (13, 22) px, stride 8: cell column 1, row 2 at (0.625, 0.75): neighbours right and below.
    made = assign(labels([9.0, 18.0, 17.0, 26.0]), ANCHORS, (8, 16), SHAPES, 1.5)
    first = made[0]
    frame, anchor, row, column = first.predictors.tolist()
    assert sorted(zip(column, row, strict=True)) == [(1, 2), (1, 3), (2, 2)]
    assert anchor == [1, 1, 1]
    assert frame == [0, 0, 0]
    assert first.boxes.tolist() == [[9.0, 18.0, 17.0, 26.0]] * 3
    assert made[1].predictors.shape == (4, 0)
    assert first.positive.sum() == 3
    assert not (first.positive & first.ignored).any()


def test_one_predictor_as_in_yolov3():
    """The anchor of highest IoU of all scales, in the cell of the centre."""
    made = assign(labels([9.0, 18.0, 17.0, 26.0], [20.0, 20.0, 60.0, 60.0]), ANCHORS, (8, 16), SHAPES, None)
    assert made[0].predictors.tolist() == [[0], [1], [2], [1]]
    # 40 px: 32 px fits better than 64 px; centre (40, 40) px is in cell (2, 2) of stride 16.
    assert made[1].predictors.tolist() == [[0], [0], [2], [2]]


def test_neighbours_off_the_grid_are_left_out():
    # Centre (1, 1) px: the nearest neighbours of cell (0, 0) are left of and above the image.
    made = assign(labels([-2.0, -2.0, 4.0, 4.0]), ANCHORS, (8, 16), SHAPES, 1.4)
    assert made[0].predictors[2:].tolist() == [[0], [0]]


def test_ignored_labels_are_neither_positive_nor_negative():
    made = assign(labels([56.0, 56.0, 72.0, 72.0], frame=[1], selected=[False]), ANCHORS, (8, 16), SHAPES, 1.5)
    assert made[0].predictors.shape == (4, 0)
    ignored = made[0].ignored.nonzero()
    # 16 px box about (64, 64): cell centres nearer than 16 / 4 + 8 / 2 = 8 px, in the anchor that fits.
    assert ignored.tolist() == [[1, 2, r, c] for r in (7, 8) for c in (7, 8)]
    assert not made[1].ignored.any()


def test_empty_batch_and_crowded_batch():
    for part in assign(labels(), ANCHORS, (8, 16), SHAPES, 2.0):
        assert part.predictors.shape == (4, 0) and part.boxes.shape == (0, 4)
        assert not part.ignored.any()
    corner = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * 120
    boxes = torch.cat([corner, corner + 6], 1)
    crowd = BatchLabels(boxes, torch.zeros(500, dtype=torch.long), torch.ones(500, dtype=torch.bool))
    made = assign(crowd, ANCHORS, (8, 16), SHAPES, 1.6)[0]
    assert {tuple(box) for box in made.boxes.tolist()} == {tuple(box) for box in boxes.tolist()}
    assert made.predictors[2:].max() < 16
