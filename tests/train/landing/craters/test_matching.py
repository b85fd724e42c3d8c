"""Sightings matched with craters, compared with a search over all pairs."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from perilune_train.landing.craters.matching import Circles, assigned, matched

GATE, SIZE_VARIANCE = 3.5, 0.02


def scattered(rng, count, most_sigma_px):
    """Centres, logarithms of radii and deviations of circles in and beside an image."""
    centre_px = rng.uniform(-10, 266, (count, 2))
    return Circles(centre_px, rng.normal(1, 0.3, count), rng.uniform(0.1, most_sigma_px, count))


@pytest.mark.parametrize("share", [0.02, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(25, 40), (40, 25), (1, 1)])
def test_as_many_as_possible_are_assigned_at_the_least_cost(shape, share):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        allowed, cost = rng.random(shape) < share, rng.uniform(0, GATE**2, shape)
        rows, columns = np.nonzero(allowed)
        first = np.concatenate([[0], np.cumsum(allowed.sum(axis=1))])
        partner = assigned(first, columns, cost[rows, columns], shape[1])
        whole = np.where(allowed, cost, 1e6)
        expected = [(row, column) for row, column in zip(*linear_sum_assignment(whole), strict=True)]
        expected = [pair for pair in expected if allowed[pair]]
        assert [(row, partner[row]) for row in np.flatnonzero(partner >= 0)] == expected


def test_only_pairs_within_the_gate_are_matched():
    """Distances along the diagonal: half of the square of a distance counts."""
    craters = Circles(np.zeros((1, 2)), np.zeros(1), np.ones(1))
    for away, expected in ((0.999, 1), (1.001, 0)):
        seen = Circles(np.full((1, 2), away * GATE * 5**0.5), np.zeros(1), np.full(1, 2.0))
        assert len(matched(seen, craters, SIZE_VARIANCE, GATE)[0]) == expected
        larger = Circles(np.zeros((1, 2)), np.full(1, away * GATE * SIZE_VARIANCE**0.5), np.full(1, 2.0))
        assert len(matched(larger, craters, SIZE_VARIANCE, GATE)[0]) == expected


def test_matches_come_with_their_differences():
    rng = np.random.default_rng(3)
    craters = scattered(rng, 200, 0.5)
    chosen = rng.permutation(200)[:50]
    shift, larger = rng.normal(0, 0.1, (50, 2)), rng.normal(0, 0.05, 50)
    seen = Circles(craters.centre_px[chosen] + shift, craters.size[chosen] + larger, np.full(50, 0.5))
    own, other, error = matched(seen, craters, SIZE_VARIANCE, GATE)
    assert len(own) > 45
    right = chosen[own] == other
    assert right.mean() > 0.9
    np.testing.assert_allclose(error[right], np.column_stack([shift, larger])[own[right]], atol=1e-12)
