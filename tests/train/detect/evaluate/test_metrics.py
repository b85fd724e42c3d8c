"""Matching and average precision by hand."""

import numpy as np
import pytest

from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.matching import (
    FALSE,
    FOUND,
    IGNORED,
    Detections,
    Matches,
    edge_range,
    find_overlaps,
    match_split,
)
from perilune_train.detect.evaluate.metrics import Curve, at_threshold, curve, figures


def square(x, y, side=10.0):
    return [x, y, x + side, y + side]


def labels(boxes, selected=None):
    boxes = np.array(boxes, float).reshape(-1, 4)
    selected = np.ones(len(boxes), bool) if selected is None else np.array(selected)
    return FrameLabels(boxes, (boxes[:, 2] - boxes[:, 0]) / 2, np.zeros((len(boxes), 5)), selected, selected)


def detections(boxes, scores=None):
    boxes = np.array(boxes, float).reshape(-1, 4)
    return Detections(boxes, np.linspace(0.9, 0.1, len(boxes)) if scores is None else np.array(scores))


def match_frame(found, truth, match_iou):
    return find_overlaps([found], [truth], [[100, 100]]).match(match_iou, (2.0, 50.0)).label


def match_one(found, truth):
    return match_split([found], [truth], (100, 100), 0.5, (2.0, 50.0))


def test_a_label_is_found_once_by_the_best_score():
    found = detections([square(1, 0), square(0, 0), square(50, 50)])
    assert match_frame(found, labels([square(0, 0)]), 0.5).tolist() == [0, -1, -1]


def test_a_detection_takes_the_free_label_of_highest_overlap():
    truth = labels([square(0, 0), square(3, 0)])
    assert match_frame(detections([square(2, 0), square(2, 0)]), truth, 0.5).tolist() == [1, 0]


def test_wanted_labels_come_before_ignored_ones():
    truth = labels([square(0, 0), square(2, 0)], [False, True])
    # The first lies exactly on the ignored label, yet overlaps the selected one enough; the second only the ignored.
    assert match_frame(detections([square(0, 0), square(-1, 0), square(0, 0)]), truth, 0.5).tolist() == [1, -2, -2]


def test_undecidable_labels_are_ignored_unless_strict():
    truth = labels([square(10, 10), square(40, 40)], [True, False])
    found = detections([square(10, 10), square(40, 40), square(-9, 20), square(70, 70, 3.0), square(70, 20)])
    matches = match_one(found, truth)
    # On a worn crater, centre off the image, radius 1.5 px: ignored. In the open: false.
    assert matches.outcome.tolist() == [FOUND, IGNORED, IGNORED, IGNORED, FALSE]
    assert matches.strict().outcome.tolist() == [FOUND, FALSE, FALSE, FALSE, FALSE]
    assert at_threshold(matches, 0.0) == pytest.approx((0.5, 1.0, 2 / 3))
    assert at_threshold(matches.strict(), 0.0) == pytest.approx((0.2, 1.0, 1 / 3))


def test_at_the_edge_only_what_lies_on_no_crater_is_false():
    """Least radius 4 px: a find of 3.5 px in the open is false there, one on a crater and one of 2.9 px are not."""
    truth = labels([square(10, 10), square(40, 40, 7.0)], [True, False])
    found = detections([square(10, 10), square(40, 40, 7.0), square(70, 70, 7.0), square(20, 70, 5.8)])
    overlaps = find_overlaps([found], [truth], [[100, 100]])
    assert overlaps.match(0.5, (4.0, 50.0)).outcome.tolist() == [FOUND, IGNORED, IGNORED, IGNORED]
    assert overlaps.match(0.5, edge_range((4.0, 50.0))).outcome.tolist() == [FOUND, IGNORED, FALSE, IGNORED]


def outcomes(*kinds, selected):
    count = len(kinds)
    none = np.zeros(count, np.intp)
    return Matches(np.linspace(0.9, 0.1, count), np.array(kinds, np.int8), none, none, np.zeros(selected, np.intp))


def test_average_precision_by_hand():
    points = curve(outcomes(FOUND, FALSE, FOUND, FALSE, selected=4))
    assert points.precision.tolist() == pytest.approx([1, 1 / 2, 2 / 3, 1 / 2])
    assert points.recall.tolist() == [0.25, 0.25, 0.5, 0.5]
    assert points.ap_paper() == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)
    # Recalls 0 .. 0.25 are 26 of the 101 points, 0.26 .. 0.50 another 25.
    assert points.ap_envelope() == pytest.approx(points.ap_paper())
    assert points.ap_coco101() == pytest.approx((26 * 1 + 25 * 2 / 3) / 101)


def test_only_the_envelope_takes_the_best_later_precision():
    points = curve(outcomes(FALSE, FOUND, FOUND, selected=2))
    assert points.ap_envelope() == pytest.approx(2 / 3)
    # Precisions 0, 1/2, 2/3 at recalls 0, 1/2, 1.
    assert points.ap_paper() == pytest.approx(0.5 * 1 / 2 + 0.5 * 2 / 3)


def test_the_papers_sum_takes_equal_scores_together():
    """The worked example of scikit-learn's average_precision_score (0.8333), and one with a tie, whatever its order."""
    scores, hits = np.array([0.8, 0.4, 0.35, 0.1]), [FOUND, FALSE, FOUND, FALSE]
    none = np.zeros(4, np.intp)
    assert curve(Matches(scores, np.array(hits, np.int8), none, none, none[:2])).ap_paper() == pytest.approx(5 / 6)
    for order in ([FOUND, FOUND, FALSE, FOUND], [FOUND, FALSE, FOUND, FOUND]):
        tied = Matches(np.array([0.9, 0.5, 0.5, 0.2]), np.array(order, np.int8), none, none, np.zeros(4, np.intp))
        # Thresholds 0.9, 0.5, 0.2: recalls 1/4, 2/4, 3/4, precisions 1, 2/3, 3/4.
        assert curve(tied).ap_paper() == pytest.approx((1 + 2 / 3 + 3 / 4) / 4)


def test_ignored_detections_do_not_move_the_curve():
    with_ignored = curve(outcomes(FOUND, IGNORED, FALSE, FOUND, IGNORED, selected=2))
    without = curve(outcomes(FOUND, FALSE, FOUND, selected=2))
    assert with_ignored.ap_paper() == pytest.approx(without.ap_paper())


def test_threshold_of_best_f1():
    points = Curve(np.array([0.9, 0.8, 0.7]), np.array([1.0, 0.5, 2 / 3]), np.array([0.25, 0.25, 0.5]))
    # F1: 0.4, 1 / 3, 4 / 7.
    assert points.best_threshold() == 0.7


def test_threshold_of_most_recall_at_a_precision():
    points = Curve(np.array([0.9, 0.8, 0.7, 0.6]), np.array([1.0, 0.5, 2 / 3, 0.5]), np.array([0.25, 0.25, 0.5, 0.5]))
    assert points.operating_threshold(None) == (0.7, "of highest F1")
    # Precision falls below 0.6 and rises again: the later point has more recall.
    assert points.operating_threshold(0.6) == (0.7, "of highest recall at a precision of at least 0.6")
    assert points.operating_threshold(0.9) == (0.9, "of highest recall at a precision of at least 0.9")
    tied = Curve(np.array([0.9, 0.8, 0.8]), np.array([1.0, 1.0, 2 / 3]), np.array([0.25, 0.5, 0.5]))
    assert tied.operating_threshold(0.9)[0] == 0.9
    without = Curve(points.scores[1:], points.precision[1:], points.recall[1:])
    assert without.operating_threshold(0.9) == (0.7, "of highest F1 (no threshold reaches a precision of 0.9)")


def test_nothing_found_and_nothing_wanted():
    none = match_one(detections([]), labels([square(0, 0)]))
    assert curve(none).ap_paper() == 0
    assert curve(none).ap_coco101() == 0
    assert curve(none).best_threshold() == 1.0
    assert at_threshold(none, 0.5) == (0, 0, 0)
    nothing_selected = match_one(detections([square(20, 20)]), labels([]))
    assert curve(nothing_selected).ap_paper() == 0


def test_figures_of_both_scoring_rules():
    truth = labels([square(0, 0, 8), square(20, 0, 8), square(40, 40, 30)], [True, True, False])
    result = figures(match_one(detections([square(0, 0, 8), square(40, 40, 30)], [0.9, 0.8]), truth), threshold=0.5)
    assert result["recall"] == result["strict/recall"] == result["ap50_paper"] == result["ap50_envelope"] == 0.5
    assert "ap50" not in result
    assert (result["precision"], result["strict/precision"]) == (1, 0.5)
    assert result["f1"] == pytest.approx(2 / 3)
