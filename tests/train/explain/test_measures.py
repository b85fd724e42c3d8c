"""Signs and pixels of PCC1 to PCC4, on gates that are known."""

import numpy as np
import pytest

from perilune_train.explain.correlation import ground_truth_mask, warped_mask
from perilune_train.explain.measures import detector_correlations, navigator_correlations, pair_correlations

_RINGS = (1.1, 1.2, 1.3, 1.4)


def follows_craters(masks, truth):
    """Whether a block's gate is strong where craters are, by what is reported of it."""
    rows = {row["measure"]: row["value"] for row in detector_correlations({"B_11": masks}, truth)}
    return rows["pcc1_craterness"] > 0.9 and rows["pcc1_background"] < -0.9


def test_the_sign_of_pcc1():
    rng = np.random.default_rng(0)
    truth = np.stack(
        [ground_truth_mask(64, 64, rng.uniform(0, 64, (6, 2)), rng.uniform(3, 9, 6), _RINGS) for _ in range(4)]
    )
    rows = {row["measure"]: row["value"] for row in detector_correlations({"B_11": 0.3 + 0.4 * (1 - truth)}, truth)}
    assert rows["pcc1_craterness"] == pytest.approx(1) and rows["pcc1_background"] == pytest.approx(-1)
    assert follows_craters(1 - truth, truth)
    for other in (truth, rng.random(truth.shape), np.roll(1 - truth, 1, axis=0)):
        assert not follows_craters(other, truth)


def pattern(x, y):
    waves = np.random.default_rng(3).uniform(-0.4, 0.4, (6, 2))
    return sum(np.sin(a * x + b * y) for a, b in waves)


def test_pcc3_and_pcc4_are_over_the_same_pixels():
    """The halves agree where both frames see the ground, even unmoved, and not outside: both measures are then 1."""
    affine = np.array([[1.0, 0, 0], [0, 1, 20]])
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    lower = pattern(u, 0 * v)
    _, seen = warped_mask(lower, affine)
    assert 0.6 < seen.mean() < 0.75
    upper = np.where(seen, lower, np.random.default_rng(0).normal(0, 3, (64, 64)))
    values = pair_correlations(np.concatenate([upper, lower]), affine)
    assert values["pcc3"] == pytest.approx(1) and values["pcc4"] == pytest.approx(1)
    assert values["pcc3_all_pixels"] < 0.9 and values["pcc4_all_pixels"] < 0.9


def test_a_moved_pair_has_a_high_pcc4_and_constant_halves_have_none():
    affine = np.array([[1.1, 0.02, 3.0], [-0.01, 1.2, -6.0]])
    u, v = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)
    upper = pattern(*(affine[i, 0] * u + affine[i, 1] * v + affine[i, 2] for i in (0, 1)))
    stacked = np.concatenate([upper, pattern(u, v)])
    flat = np.concatenate([upper, np.full((64, 64), 0.5)])
    rows = {row["measure"]: row for row in navigator_correlations("B_11", np.stack([stacked, flat]), [affine, affine])}
    assert rows["pcc4"]["value"] > 0.99 and rows["pcc3"]["value"] < 0.5
    assert rows["pcc3"]["undefined"] == rows["pcc4"]["undefined"] == 1
