"""k-means over sizes."""

import numpy as np
import pytest

from perilune_train.detect.anchors import best_possible_recall, kmeans_anchors, size_iou


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
