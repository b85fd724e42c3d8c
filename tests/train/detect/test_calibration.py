"""Scores are mapped to probabilities by an increasing function that is fitted to matches."""

import numpy as np
import pytest

from perilune_train.detect.calibration import MIN_EACH, Calibration, fit_calibration

KNOWN = Calibration(1.7, 0.6, 0.8)


def drawn(calibration, count=40_000, seed=0):
    """Scores (count,), and matches drawn with the probabilities of a calibration."""
    rng = np.random.default_rng(seed)
    scores = rng.beta(0.6, 0.9, count)
    return scores, rng.random(count) < calibration.probabilities(scores)


def test_a_known_map_is_found_again():
    fitted = fit_calibration(*drawn(KNOWN))
    scores = np.linspace(0.01, 0.99, 99)
    assert np.abs(fitted.probabilities(scores) - KNOWN.probabilities(scores)).max() < 0.015


def test_the_fit_has_the_highest_likelihood():
    scores, matched = drawn(KNOWN, 3000)

    def loss(calibration):
        p = calibration.probabilities(scores)
        return -np.mean(np.where(matched, np.log(p), np.log(1 - p)))

    fitted = fit_calibration(scores, matched)
    for shift in np.vstack([0.05 * np.eye(3), -0.05 * np.eye(3)]):
        other = Calibration(fitted.log_score + shift[0], fitted.log_complement + shift[1], fitted.offset + shift[2])
        assert loss(other) > loss(fitted)


def test_the_map_increases_strictly_over_all_float32_scores():
    scores = np.r_[np.float32(0.01), np.nextafter(np.float32(0.5), np.float32([0, 1])), np.float32(1 - 2.0**-24)]
    assert (np.diff(KNOWN.probabilities(np.sort(scores))) > 0).all()
    ends = KNOWN.probabilities(np.array([0.0, 1.0]))
    assert np.isfinite(ends).all() and 0 <= ends[0] < ends[1] <= 1


def test_one_score_is_mapped_like_many():
    scores = np.random.default_rng(1).random(1001).astype(np.float32)
    assert [KNOWN.probability(score) for score in scores] == KNOWN.probabilities(scores).tolist()


def test_a_score_that_separates_all_detections_gives_a_finite_map():
    scores = np.r_[np.full(MIN_EACH, 0.2), np.full(MIN_EACH, 0.8)]
    low, high = fit_calibration(scores, scores > 0.5).probabilities(np.array([0.2, 0.8]))
    assert 0 < low < 0.05 and 0.95 < high < 1


@pytest.mark.parametrize("slope", [-1, 1])
def test_without_information_there_is_no_map(slope):
    scores = np.linspace(0.01, 0.99, 1000)
    few = np.arange(1000) < MIN_EACH - 1
    assert fit_calibration(scores, few) is None and fit_calibration(scores, ~few) is None
    falling = np.random.default_rng(0).random(1000) < (0.5 + slope * (scores - 0.5) * 0.9)
    assert (fit_calibration(scores, falling) is None) == (slope < 0)


def test_a_negative_factor_is_left_out():
    """Matches are rarer again at the highest scores: the free fit would fall there."""
    rng = np.random.default_rng(2)
    scores = rng.random(20_000)
    fitted = fit_calibration(scores, rng.random(20_000) < np.where(scores < 0.5, scores, 1 - 0.6 * scores))
    assert min(fitted.log_score, fitted.log_complement) == 0 < max(fitted.log_score, fitted.log_complement)
