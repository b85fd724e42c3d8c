"""Sightings matched with craters, compared with a search over all pairs."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from perilune_train.navigate.craters.matching import Circles, assigned, matched, near_pairs

GATE, SIZE_VARIANCE = 3.5, 0.02


def scattered(rng, count, most_sigma_px):
    """Centres, logarithms of radii and deviations of circles in and beside an image."""
    centre_px = rng.uniform(-10, 266, (count, 2))
    return Circles(centre_px, rng.normal(1, 0.3, count), rng.uniform(0.1, most_sigma_px, count))


def costs(seen, craters):
    """Costs (M, N) of all pairs."""
    (place, size, sigma), (other_place, other_size, other_sigma) = seen, craters
    squared = ((place[:, None] - other_place) ** 2).sum(axis=2) / (sigma[:, None] ** 2 + other_sigma**2) / 2
    return squared + (size[:, None] - other_size) ** 2 / SIZE_VARIANCE


@pytest.mark.parametrize("most_sigma_px", [0.5, 8.0])
@pytest.mark.parametrize(("n_seen", "n_craters"), [(40, 300), (60, 30), (3, 1), (5, 0), (0, 5)])
def test_pairs_are_all_those_within_the_gate(n_seen, n_craters, most_sigma_px):
    rng = np.random.default_rng(n_craters)
    seen, craters = scattered(rng, n_seen, most_sigma_px), scattered(rng, n_craters, most_sigma_px)
    whole = costs(seen, craters)
    first, crater, cost = near_pairs(seen, craters, SIZE_VARIANCE, GATE)
    found = np.full_like(whole, np.inf)
    found[np.repeat(np.arange(n_seen), np.diff(first)), crater] = cost
    assert (found < np.inf).sum() == len(cost)
    np.testing.assert_allclose(found, np.where(whole < GATE**2, whole, np.inf), rtol=1e-12)


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
