"""Batches of craters that are removed together."""

import numpy as np
from tests.helpers.scenes import round_craters

from perilune_render.detectability.removals import SIGNAL_RADII, removal_batches, removal_reach_m
from perilune_render.terrain.albedo import RAYS_REACH
from perilune_render.terrain.craters.removal import REACH_RADII


def craters(n=300):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-500, 500, (2, n))
    diameter = 4 * rng.pareto(2, n) + 4
    wear = np.where(rng.random(n) < 0.1, 1e-3, 0.05)
    return round_craters(np.stack([x, y, diameter, np.full(n, 0.2), wear], axis=1))


def test_every_crater_is_in_one_batch():
    batches = removal_batches(craters())
    assert sorted(np.concatenate(batches)) == list(range(300))
    assert 2 < len(batches) < 60


def test_no_removal_changes_the_window_of_another_crater():
    every = craters()
    radius, reach = every.diameter_m / 2, removal_reach_m(every)
    for batch in removal_batches(every):
        distance = np.hypot(
            np.subtract.outer(every.x_m[batch], every.x_m[batch]), np.subtract.outer(every.y_m[batch], every.y_m[batch])
        )
        gap = distance - reach[batch][:, None] - SIGNAL_RADII * radius[batch][None]
        np.fill_diagonal(gap, 1)
        assert (gap > -1e-9).all()


def test_craters_that_may_have_rays_reach_farther():
    two = round_craters([[0, 0, 20, 0.2, 1e-3], [500, 0, 20, 0.2, 0.05]])
    assert removal_reach_m(two).tolist() == [10 * RAYS_REACH, 10 * REACH_RADII]
