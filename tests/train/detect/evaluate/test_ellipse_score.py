"""NASA's score by hand and by the challenge's own form of the formula."""

import math

import numpy as np
import pytest

from perilune_train.detect.evaluate.ellipse_score import (
    ellipse_score,
    gaussian_angles,
    image_score,
    matched_ellipses,
)


def circle(x, y, r):
    return [x, y, r, r, 0.0]


def rows(*ellipses):
    return np.array(ellipses, float).reshape(-1, 5)


def as_stated(first, second):
    """The distance with the inverse matrices Y, as the challenge states it."""

    def inverse(a, b, theta):
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        return turn @ np.diag([1 / a**2, 1 / b**2]) @ turn.T

    y1, y2 = inverse(*first[2:]), inverse(*second[2:])
    offset = np.array(first[:2]) - np.array(second[:2])
    both = y1 + y2
    exponent = -offset @ y1 @ np.linalg.inv(both) @ y2 @ offset / 2
    return math.acos(
        min(1, 4 * math.sqrt(np.linalg.det(y1) * np.linalg.det(y2)) / np.linalg.det(both) * math.exp(exponent))
    )


def test_distances_by_hand():
    # Equal circles d apart: cos = exp(-d^2 / (4 r^2)). Concentric circles: cos = 4 r^2 s^2 / (r^2 + s^2)^2.
    found = gaussian_angles(
        rows(circle(0, 0, 5), circle(0, 0, 5), circle(0, 0, 5)),
        rows(circle(3, 4, 5), circle(0, 0, 10), circle(0, 0, 5)),
    )
    assert found == pytest.approx([math.acos(math.exp(-0.25)), math.acos(4 * 25 * 100 / 125**2), 0], abs=1e-7)


def test_distances_equal_the_form_of_the_challenge():
    rng = np.random.default_rng(0)
    pairs = [
        np.column_stack(
            [rng.uniform(-3, 3, (50, 2)), rng.uniform(4, 9, 50), rng.uniform(2, 4, 50), rng.uniform(0, 3, 50)]
        )
        for _ in range(2)
    ]
    expected = [as_stated(first, second) for first, second in zip(*pairs, strict=True)]
    np.testing.assert_allclose(gaussian_angles(*pairs), expected, atol=1e-7)
    np.testing.assert_allclose(gaussian_angles(*pairs[::-1]), expected, atol=1e-7)


def test_a_rim_error_decides_what_matches():
    """For circles, (d / s)^2 < 13.277 with s = 0.0595 means d < 0.2168."""
    limit = 0.85 * 0.07 * math.sqrt(13.277)
    # cos d = exp(-x^2 / 400) for circles of 10 px that are x apart.
    apart = math.sqrt(-400 * math.log(math.cos(limit)))
    for x, taken in ((apart - 0.01, 0), (apart + 0.01, -1)):
        found, angle = matched_ellipses(rows(circle(x, 0, 10)), rows(circle(0, 0, 10)))
        assert found.tolist() == [taken] and np.isnan(angle[0]) == (taken < 0)
    # A flat label has a smaller s: b / sqrt(a b) times 0.0595.
    assert matched_ellipses(rows([1.5, 0, 20, 5, 0]), rows([0, 0, 20, 5, 0]))[0].tolist() == [0]
    assert matched_ellipses(rows([0, 1.5, 20, 5, 0]), rows([0, 0, 20, 5, 0]))[0].tolist() == [-1]


def test_each_label_in_turn_takes_the_nearest_free_detection():
    labels = rows(circle(0, 0, 10), circle(1, 0, 10), circle(50, 50, 10))
    detections = rows(circle(0.6, 0, 10), circle(2, 0, 10), circle(-1, 0, 10))
    taken, angles = matched_ellipses(detections, labels)
    # The second label is nearest to the first detection too, which is taken.
    assert taken.tolist() == [0, 1, -1]
    assert angles[:2] == pytest.approx([math.acos(math.exp(-0.36 / 400)), math.acos(math.exp(-1 / 400))])
    assert matched_ellipses(detections[:1], labels)[0].tolist() == [0, -1, -1]


def test_score_of_an_image_by_hand():
    labels = rows(*(circle(40 * k, 0, 10) for k in range(4)))
    exact = image_score(labels, labels)
    assert exact == pytest.approx(1)
    # Two of four found, one of three detections false.
    found = rows(circle(0, 0, 10), circle(42, 0, 10), circle(300, 0, 10))
    d = math.acos(math.exp(-4 / 400))
    assert image_score(found, labels) == pytest.approx((1 + 1 - d / math.pi) / 3 * 2 / 4)
    # Of many labels, ten matches are enough.
    many = rows(*(circle(40 * k, 0, 10) for k in range(30)))
    assert image_score(many[:10], many) == pytest.approx(1) and image_score(many[:5], many) == pytest.approx(0.5)


def test_images_without_craters_or_detections():
    some = rows(circle(0, 0, 5))
    assert [image_score(some[:0], some), image_score(some, some[:0]), image_score(some[:0], some[:0])] == [0, 0, 1]
    assert ellipse_score([some, some[:0]], [some, some]) == pytest.approx(50)
    assert math.isnan(ellipse_score([], []))
