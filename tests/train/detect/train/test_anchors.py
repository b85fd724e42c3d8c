"""k-means over sizes."""

import numpy as np
import pytest

from perilune_train.detect.train.anchors import best_possible_recall, kmeans_anchors, mean_best_iou, size_iou


def test_size_iou_by_hand():
    np.testing.assert_allclose(size_iou(np.array([[2.0, 4.0]]), np.array([[4.0, 2.0], [2.0, 4.0]])), [[4 / 12, 1.0]])


def test_clusters_are_found_and_sorted():
    rng = np.random.default_rng(0)
    centres = np.array([[5.0, 5.0], [12.0, 11.0], [40.0, 44.0]])
    sizes = (centres[:, None] * rng.uniform(0.97, 1.03, (3, 200, 2))).reshape(-1, 2)
    rng.shuffle(sizes)
    np.testing.assert_allclose(kmeans_anchors(sizes, 3, rng), centres, rtol=0.01)


def test_same_generator_state_gives_the_same_anchors():
    sizes = np.random.default_rng(1).uniform(4, 60, (30_000, 2))
    first, second = (kmeans_anchors(sizes, 9, np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(first, second)


def test_fewer_distinct_sizes_than_anchors():
    anchors = kmeans_anchors(np.full((5, 2), 7.0), 3, np.random.default_rng(0))
    np.testing.assert_allclose(anchors, 7.0)


def test_no_sizes():
    with pytest.raises(ValueError, match="no sizes"):
        kmeans_anchors(np.zeros((0, 2)), 3, np.random.default_rng(0))


def test_best_possible_recall_by_hand():
    sizes = np.array([[10.0, 10.0], [19.0, 10.0], [21.0, 10.0], [4.9, 10.0]])
    assert best_possible_recall(sizes, np.array([[10.0, 10.0]]), 2.0) == 0.5


def test_mean_best_iou_by_hand():
    # 4 x 4 in 8 x 8: 16 / 64. 8 x 8 fits. 8 x 4 is half of 8 x 8; against 2 x 2 it would be 4 / 32.
    sizes = np.array([[4.0, 4.0], [8.0, 8.0], [8.0, 4.0]])
    assert mean_best_iou(sizes, np.array([[8.0, 8.0], [2.0, 2.0]])) == pytest.approx((0.25 + 1 + 0.5) / 3)
    assert mean_best_iou(sizes, sizes) == 1.0


def test_clusters_fit_better_than_evenly_spaced_squares():
    sizes = np.random.default_rng(2).lognormal(2.3, 0.6, (3000, 2))
    area = np.log(sizes.prod(axis=1))
    side = np.exp(np.linspace(area.min(), area.max(), 9) / 2)
    found = kmeans_anchors(sizes, 9, np.random.default_rng(0))
    assert mean_best_iou(sizes, found) > mean_best_iou(sizes, np.stack([side, side], 1)) + 0.05


def test_the_seed_alone_decides_which_sizes_are_drawn():
    sizes = np.random.default_rng(1).lognormal(2.5, 0.5, (25_000, 2))
    one, same, other = (kmeans_anchors(sizes, 9, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_plain_sampling_follows_the_frequency():
    """Craters fall off with the square of their size: without weights the anchors are smaller."""
    side = np.minimum(4 / np.sqrt(np.random.default_rng(2).uniform(0.001, 1, 20_000)), 100)
    sizes = np.stack([side, side], axis=1)
    rare, plain = (kmeans_anchors(sizes, 9, np.random.default_rng(0), plain=plain) for plain in (False, True))
    assert np.median(plain) < 0.9 * np.median(rare)
