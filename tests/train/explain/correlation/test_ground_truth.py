import numpy as np
import pytest

from perilune_train.explain.inputs import ellipse_mask, ground_truth_mask

_RINGS = (1.1, 1.2, 1.3, 1.4)


def test_ground_truth_mask_has_the_papers_rings():
    mask = ground_truth_mask(101, 101, [[50.5, 50.5]], [20.0], _RINGS)
    # Pixel (50, 50 + k) has its centre k pixels from the crater's: 20 px radius, rings of 2 px.
    assert [mask[50, 50 + k] for k in (0, 20, 21, 22, 23, 25, 27, 28, 29)] == pytest.approx(
        [0, 0, 0.2, 0.2, 0.4, 0.6, 0.8, 0.8, 1]
    )
    assert mask[50, 50 - 27] == pytest.approx(0.8) and mask[50 + 25, 50] == pytest.approx(0.6)


def test_overlapping_craters_take_the_least_and_edges_are_safe():
    both = ground_truth_mask(60, 40, [[20, 20], [32, 20], [-100, 5], [59, 39]], [10, 10, 3, 8], _RINGS)
    one = ground_truth_mask(60, 40, [[20, 20]], [10], _RINGS)
    two = ground_truth_mask(60, 40, [[32, 20], [59, 39]], [10, 8], _RINGS)
    np.testing.assert_array_equal(both, np.minimum(one, two))
    assert np.all(ground_truth_mask(8, 8, np.zeros((0, 2)), [], _RINGS) == 1)


def test_a_perfect_mask_has_the_pixels_in_ellipses():
    mask = ellipse_mask((60, 80), np.array([[30.0, 25.0, 12.0, 4.0, np.pi / 6], [79.0, 59.0, 5.0, 5.0, 0.0]]))
    rotation = np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6)], [-np.sin(np.pi / 6), np.cos(np.pi / 6)]])
    for row in range(60):
        for column in range(80):
            along, across = rotation @ [column + 0.5 - 30, row + 0.5 - 25]
            inside = (along / 12) ** 2 + (across / 4) ** 2 <= 1
            inside |= np.hypot(column + 0.5 - 79, row + 0.5 - 59) <= 5
            assert mask[row, column] == inside
    assert not ellipse_mask((8, 8), np.zeros((0, 5))).any()
