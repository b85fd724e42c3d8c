"""Neighbours by the grid, compared with distances to all points."""

import numpy as np
import pytest

from perilune_train.landing.craters.neighbours import grid_of, nearest, within_reach

SIZES = [0, 1, 2, 7, 300]


@pytest.mark.parametrize("n_points", SIZES)
@pytest.mark.parametrize("most", [0.0, 3.0, 40.0, 600.0])
def test_points_within_reach_are_all_those(n_points, most):
    rng = np.random.default_rng(n_points)
    place, reach = rng.uniform(-50, 306, (40, 2)), rng.uniform(0, most, 40)
    points = rng.uniform(-10, 266, (n_points, 2))
    first, other = within_reach(place, reach, points)
    found = np.zeros((40, n_points), int)
    np.add.at(found, (np.repeat(np.arange(40), np.diff(first)), other), 1)
    np.testing.assert_array_equal(found, np.abs(place[:, None] - points).max(axis=2, initial=0.0) <= reach[:, None])


@pytest.mark.parametrize("n_points", SIZES)
@pytest.mark.parametrize("count", [1, 10, 1000])
@pytest.mark.parametrize("stretch", [1.0, 50.0])
def test_the_nearest_points_are_all_those(n_points, count, stretch):
    """In and beside the grid, with square and with long cells."""
    rng = np.random.default_rng(n_points)
    points = rng.normal(0, [100, 100 / stretch], (n_points, 2))
    grid = grid_of(points)
    for x, y in rng.normal(0, 200, (50, 2)):
        distance = np.hypot(*(points - [x, y]).T)
        np.testing.assert_array_equal(nearest(grid, x, y, count), np.argsort(distance)[:count])


def test_points_at_one_place_have_neighbours():
    points = np.ones((5, 2))
    assert set(nearest(grid_of(points), 0.0, 0.0, 5)) == set(range(5))
    assert set(within_reach(np.zeros((1, 2)), np.ones(1), points)[1]) == set(range(5))
