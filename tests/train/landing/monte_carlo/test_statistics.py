"""Bands and bounds: by simulation of what they promise, and by published values."""

import numpy as np
import pytest

from perilune_train.landing.monte_carlo.statistics import (
    ellipse,
    mean_band,
    needed_draws,
    quantile_bound,
    share_bound,
    supported_share,
)


def test_the_band_contains_means_with_its_probability():
    rng = np.random.default_rng(0)
    means = rng.chisquare(6, (20_000, 25)).mean(axis=1)
    low, high = mean_band(6, 25)
    inside = (means > low) & (means < high)
    assert abs(inside.mean() - 0.95) < 0.006
    assert abs((means <= low).mean() - 0.025) < 0.005


@pytest.mark.parametrize(("count", "n"), [(0, 300), (2, 300), (4, 5)])
def test_at_the_bound_of_a_share_so_few_events_happen_with_5_percent(count, n):
    rng = np.random.default_rng(1)
    assert abs((rng.binomial(n, share_bound(count, n), 200_000) <= count).mean() - 0.05) < 0.002


def test_bounds_of_extreme_shares():
    assert np.isclose(share_bound(0, 300), 1 - 0.05 ** (1 / 300))
    assert share_bound(5, 5) == 1


def test_a_bound_of_99_percent_needs_299_draws():
    """Tolerance bounds of Wilks: 59 values for 95 %, 299 for 99 %."""
    assert (needed_draws(0.95), needed_draws(0.99)) == (59, 299)
    values = np.random.default_rng(2).exponential(size=299)
    assert quantile_bound(values, 0.99) == values.max()
    assert np.isnan(quantile_bound(values[:298], 0.99))
    assert supported_share(298) < 0.99 <= supported_share(299)


@pytest.mark.parametrize("n", [299, 700])
def test_the_bound_of_a_quantile_holds_with_its_confidence(n):
    rng = np.random.default_rng(n)
    true = -np.log(0.01)
    bounds = [quantile_bound(rng.exponential(size=n), 0.99) for _ in range(2000)]
    held = np.mean(np.array(bounds) >= true)
    assert 0.945 < held < 0.985


def test_an_ellipse_contains_its_share():
    rng = np.random.default_rng(3)
    turn = np.radians(30.0)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = rng.normal(size=(50_000, 2)) * [3.0, 1.0] @ axes.T
    major, minor, azimuth_deg = ellipse(np.cov(points.T))
    assert np.isclose(azimuth_deg, 30, atol=0.5)
    along = points @ axes / [major, minor]
    assert abs(((along**2).sum(axis=1) < 1).mean() - 0.95) < 0.004
    assert np.isclose(major / minor, 3, rtol=0.02)
