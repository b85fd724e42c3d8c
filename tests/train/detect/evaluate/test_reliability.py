"""Expected calibration errors and the reliability diagram."""

import numpy as np
import pytest

from perilune_train.detect.calibration import Calibration
from perilune_train.detect.data.labels import FrameLabels
from perilune_train.detect.evaluate.matching import Detections, find_overlaps
from perilune_train.detect.evaluate.metrics import curve
from perilune_train.detect.evaluate.reliability import (
    ScoredMatches,
    calibration_errors,
    decided_matches,
    draw_reliability,
    expected_calibration_error,
    reliability,
)


def test_an_error_by_hand():
    """Two bins of two detections: scores 0.1, 0.3 with no match, 0.6, 0.8 with one match."""
    found = ScoredMatches(np.array([0.8, 0.1, 0.6, 0.3]), np.array([True, False, False, False]))
    mean, share, count = reliability(found, bins=2)
    assert mean == pytest.approx([0.2, 0.7]) and share == pytest.approx([0, 0.5]) and count.tolist() == [2, 2]
    assert expected_calibration_error(found, bins=2) == pytest.approx((0.2 + 0.2) / 2)
    assert expected_calibration_error(found, equal_width=True, bins=4) == pytest.approx((0.1 + 0.3 + 0.6 + 0.2) / 4)


def test_true_probabilities_have_a_small_error():
    rng = np.random.default_rng(0)
    scores = rng.random(30_000)
    matched = rng.random(30_000) < scores
    assert expected_calibration_error(ScoredMatches(scores, matched)) < 0.015
    assert expected_calibration_error(ScoredMatches(scores**2, matched)) > 0.1


def test_nothing_has_no_error(tmp_path):
    nothing = ScoredMatches(np.zeros(0), np.zeros(0, bool))
    assert np.isnan(expected_calibration_error(nothing))
    draw_reliability(nothing, tmp_path / "empty.png")
    assert (tmp_path / "empty.png").stat().st_size > 1000


def circles(*rows):
    """Boxes around circles, rows of centre and radius."""
    return np.array([[x - r, y - r, x + r, y + r] for x, y, r in rows], float)


@pytest.fixture
def overlaps():
    """Labels of 10 px (selected) and of 2.1 px (selected, at the limit), and an ignored one of 5 px."""
    boxes = circles((20, 20, 10), (60, 20, 2.1), (60, 60, 5))
    radius = np.array([10, 2.1, 5])
    ellipses = np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, radius, radius, np.zeros(3)])
    selected = np.array([True, True, False])
    labels = FrameLabels(boxes, radius, ellipses, selected, np.ones(3, bool))
    found = circles((20, 20, 9.5), (60, 20, 1.9), (60, 60, 5), (90, 20, 6), (20, 20, 11), (90, 90, 1.5))
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    return find_overlaps([Detections(found, scores)], [labels], np.array([[100, 100]]))


def test_detections_that_labels_cannot_decide_are_left_out(overlaps):
    """Left out: 0.8, which matches below the smallest radius, 0.7 on an ignored label, and 0.4, too small."""
    found = decided_matches(overlaps, overlaps.match(0.5, (2.0, 50.0)), (2.0, 50.0))
    assert found.scores.tolist() == [0.9, 0.6, 0.5] and found.matched.tolist() == [True, False, False]
    assert found.above(0.6).scores.tolist() == [0.9, 0.6]


def test_errors_by_rule(overlaps):
    errors = calibration_errors(overlaps, overlaps.match(0.5, (2.0, 50.0)), (2.0, 50.0), 0.55)
    assert errors["ece"] == pytest.approx((0.1 + 0.6 + 0.5) / 3)
    assert errors["ece_above_threshold"] == pytest.approx((0.1 + 0.6) / 2)
    assert errors["strict/ece"] == pytest.approx((0.1 + 0.2 + 0.7 + 0.6 + 0.5 + 0.4) / 6)
    assert errors["any_label/ece"] == pytest.approx((0.1 + 0.2 + 0.3 + 0.6 + 0.5 + 0.4) / 6)


def test_calibration_changes_no_ap(overlaps):
    matches = overlaps.match(0.5, (2.0, 50.0))
    probabilities = Calibration(2.0, 0.3, -1.0).probabilities(overlaps.scores)
    labels = overlaps.label_boxes
    assert (np.diff(probabilities) < 0).all() and len(labels) == 3
    mapped = type(matches)(probabilities, matches.outcome, matches.label, matches.frame, matches.selected_frame)
    assert curve(mapped).ap_paper() == curve(matches).ap_paper()
