"""Ellipses as boxes with correlations, against drawn points."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from perilune_train.detect.ellipses import correlations_of, ellipses_of
from perilune_train.detect.evaluate.matching import Detections, joined_detections
from perilune_train.models.ellipse import decode_sigmas, semi_axes

ANGLE = np.linspace(0, 2 * np.pi, 100_000)


def rim(ellipse):
    """Points (100,000, 2) on an ellipse."""
    x, y, a, b, theta = ellipse
    along, across = a * np.cos(ANGLE), b * np.sin(ANGLE)
    return np.column_stack(
        [
            x + along * np.cos(theta) - across * np.sin(theta),
            y + along * np.sin(theta) + across * np.cos(theta),
        ]
    )


def box_of(points):
    return np.concatenate([points.min(0), points.max(0)])[None]


@given(st.floats(0.5, 60), st.floats(0.15, 1), st.floats(0, np.pi - 1e-6))
def test_a_box_and_a_correlation_determine_the_ellipse(a, ratio, theta):
    ellipse = np.array([[3.0, -2.0, a, a * ratio, theta]])
    points = rim(ellipse[0])
    found = ellipses_of(box_of(points), correlations_of(ellipse))
    np.testing.assert_allclose(found[0, :4], ellipse[0, :4], rtol=1e-6, atol=1e-6)
    if ratio < 0.999:
        turn = (found[0, 4] - theta + np.pi / 2) % np.pi - np.pi / 2
        assert turn == pytest.approx(0, abs=1e-5)
    # The definition: the correlation of the points' coordinates.
    drawn = np.corrcoef(points[:-1].T)[0, 1] if ratio < 0.999 else correlations_of(ellipse)[0]
    assert correlations_of(ellipse)[0] == pytest.approx(drawn, abs=1e-5)
    axes = semi_axes(torch.as_tensor(box_of(points)), torch.as_tensor(correlations_of(ellipse)))
    np.testing.assert_allclose(axes[0].numpy(), ellipse[0, 2:4], rtol=1e-6)


def test_directions_are_in_the_range_of_the_labels():
    boxes = np.array([[0.0, 0, 4, 4], [0, 0, 6, 4], [0, 0, 4, 6], [0, 0, 6, 4], [0, 0, 0, 0], [0, 0, 6, 4]])
    correlations = np.array([0.0, 0.0, 0.0, -1e-18, 0.0, -0.1])
    found = ellipses_of(boxes, correlations)
    assert np.degrees(found[:4, 4]).tolist() == [0, 0, 90, 0]
    assert found[4, 2:].tolist() == [0, 0, 0] and 170 < np.degrees(found[5, 4]) < 180
    assert correlations_of(found).tolist() == pytest.approx(correlations.tolist(), abs=1e-12)


def test_detections_keep_their_shapes():
    shapes = np.array([[0.5, 1, 2, 3, 4], [-0.2, 5, 6, 7, 8]])
    found = Detections(np.array([[0.0, 0, 8, 4], [10, 10, 14, 18]]), np.array([0.9, 0.8]), shapes)
    assert found.take(np.array([1])).shapes.tolist() == [shapes[1].tolist()]
    small = found.moved(2, 4).divided(2, 4)
    assert small.boxes.tolist() == [[1, 1, 5, 2], [6, 3.5, 8, 5.5]]
    factors = small.ellipses[0, 2:4] / found.ellipses[0, 2:4]
    np.testing.assert_allclose(small.shapes[0], [0.5, 0.5, 0.5, *([3, 4] * factors)])
    plain = Detections(found.boxes, found.scores)
    assert plain.ellipses[0].tolist() == [4, 2, 4, 2, 0] and plain.divided(2, 2).shapes is None
    both = joined_detections([found, small])
    assert both.shapes.shape == (4, 5) and joined_detections([plain, plain]).shapes is None


def test_an_ellipse_of_a_stretched_image_is_stretched():
    """A correlation does not change, so boxes alone are resized."""
    ellipse = np.array([[30.0, 40.0, 12.0, 5.0, 0.7]])
    found = Detections(box_of(rim(ellipse[0])), np.ones(1), np.array([[correlations_of(ellipse)[0], 1, 1, 1, 1]]))
    stretched = rim(ellipse[0]) / [1.25, 0.8]
    expected = rim(found.divided(1.25, 0.8).ellipses[0])
    centre = stretched[:-1].mean(0)
    np.testing.assert_allclose(np.cov((stretched - centre).T), np.cov((expected - centre).T), rtol=1e-3)


def test_standard_deviations_by_hand():
    box = torch.tensor([[0.0, 0.0, 32.0, 8.0]])
    sigmas = decode_sigmas(torch.tensor([[9.0, 2.0, 3.0, -50.0, 50.0]]), box)
    # sqrt(sqrt(32 * 8)) = 4; outputs beyond 4 are clamped.
    torch.testing.assert_close(sigmas, 4 * torch.tensor([[0.0, 1.0, -6.0, 2.0]]).exp())
