"""Overlap and suppression by hand."""

import cv2
import numpy as np
import pytest

from perilune_train.detect.evaluate.boxes import iou_matrix, suppress


def test_iou_by_hand():
    boxes = [[0, 0, 2, 2], [1, 1, 3, 3], [5, 5, 6, 6], [1, 1, 1, 1]]
    expected = [[1, 1 / 7, 0, 0], [1 / 7, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(iou_matrix(boxes, boxes), expected)
    assert iou_matrix(np.zeros((0, 4)), boxes).shape == (0, 4)


def test_suppression_keeps_the_better_of_two():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 9], [20, 0, 30, 10], [0, 0, 10, 4]], float)
    scores = np.array([0.5, 0.9, 0.3, 0.4])
    # Box 0 overlaps box 1 by 0.9; box 3 by 4 / 9, which is below the threshold.
    assert suppress(boxes, scores, 0.5, 10).tolist() == [1, 3, 2]
    assert suppress(boxes, scores, 0.4, 10).tolist() == [1, 2]
    assert suppress(boxes, scores, 0.5, 2).tolist() == [1, 3]
    assert suppress(boxes[:0], scores[:0], 0.5, 2).tolist() == []


def test_a_suppressed_box_suppresses_nothing():
    boxes = np.array([[0, 0, 10, 10], [4, 0, 14, 10], [8, 0, 18, 10]], float)
    # Neighbours overlap by 6 / 14; the outer two by 2 / 18.
    assert suppress(boxes, np.array([0.9, 0.8, 0.7]), 0.4, 10).tolist() == [0, 2]


def test_a_crowd_is_kept_whole():
    # 400 craters, each found by 12 predictors that agree: none may be lost because the others' doubles come first.
    corner = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 12.0
    boxes = np.repeat(np.concatenate([corner, corner + 10], axis=1), 12, axis=0)
    scores = np.random.default_rng(0).uniform(0.1, 1, len(boxes))
    kept = suppress(boxes, scores, 0.5, 1000)
    assert len(np.unique(boxes[kept], axis=0)) == len(kept) == 400
    assert (np.diff(scores[kept]) <= 0).all()


def undecided(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes and scores as of a network that is hardly trained: most of them are kept. Some scores are equal."""
    rng = np.random.default_rng(count)
    corner, side = rng.uniform(0, 256, (count, 2)), rng.lognormal(2.0, 0.5, (count, 1))
    return np.concatenate([corner, corner + side], axis=1), rng.uniform(0.01, 0.2, count).round(2)


@pytest.mark.parametrize("most", [1, 7, 100, 899, 900, 5000])
def test_a_limit_keeps_the_first_of_all(most):
    boxes, scores = undecided(1500)
    every = suppress(boxes, scores, 0.45, 10**6)
    assert 900 < len(every) < 1500
    assert suppress(boxes, scores, 0.45, most).tolist() == every[:most].tolist()


def test_boxes_below_the_limit_are_not_compared(monkeypatch):
    compared, opencv = [], cv2.dnn.NMSBoxes

    def counted(boxes, *rest):
        compared.append(len(boxes))
        return opencv(boxes, *rest)

    monkeypatch.setattr(cv2.dnn, "NMSBoxes", counted)
    assert len(suppress(*undecided(16000), 0.45, 200)) == 200
    assert sum(compared) < 1000
