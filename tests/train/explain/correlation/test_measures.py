"""Signs and pixels of PCC1 to PCC4, on masks that are known."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.correlation.homography import seen_in_second
from perilune_train.explain.correlation.measures import COLUMNS, FrameTargets, PairTargets, detector_values, pair_values
from perilune_train.explain.correlation.pearson import pearson
from perilune_train.explain.inputs import ground_truth_mask

_RINGS = (1.1, 1.2, 1.3, 1.4)


def _truth(count=4):
    rng = np.random.default_rng(0)
    centres = [rng.uniform(0, 64, (6, 2)) for _ in range(count)]
    return np.stack([ground_truth_mask(64, 64, one, rng.uniform(3, 9, 6), _RINGS) for one in centres])


def _detector(masks, truth, scenes=None, **options):
    brightness, gradient = np.random.default_rng(9).random((2, *truth.shape))
    names = [f"s/t/{n}" for n in range(len(truth))]
    scenes = scenes or [f"s{n}" for n in range(len(truth))]
    return detector_values(masks, FrameTargets(truth, brightness, gradient, names, scenes), **options)


def _means(table):
    return table.groupby("measure")["value"].mean()


def test_the_sign_of_pcc1():
    truth = _truth()
    table = _detector({"B_11": 0.3 + 0.4 * (1 - truth)}, truth)
    assert tuple(table.columns) == COLUMNS and len(table) == 4 * 4
    assert (table["task"] == "detect").all() and (table["kind"] == "gate").all()
    means = _means(table)
    assert means["pcc1_craterness"] == pytest.approx(1) and means["pcc1_background"] == pytest.approx(-1)
    assert means["pcc1_partial"] == pytest.approx(1)
    assert _means(_detector({"B_11": truth}, truth))["pcc1_craterness"] == pytest.approx(-1)
    for other in (np.random.default_rng(1).random(truth.shape), np.roll(1 - truth, 1, axis=0)):
        assert abs(_means(_detector({"B_11": other}, truth))["pcc1_craterness"]) < 0.3


def test_pcc1_partial_is_given_brightness_and_gradient():
    truth, rng = _truth(), np.random.default_rng(2)
    brightness = (1 - truth) + 0.3 * rng.standard_normal(truth.shape)
    gradient = rng.random(truth.shape)
    mask = brightness + 0.05 * rng.standard_normal(truth.shape)
    names = list("abcd")
    means = _means(detector_values({"B_11": mask}, FrameTargets(truth, brightness, gradient, names, names)))
    assert means["pcc1_craterness"] > 0.6 and abs(means["pcc1_partial"]) < 0.05


def test_pcc2_pairs_all_other_frames_or_those_of_other_scenes():
    one = np.array([[0.0, 1], [0, 1]])
    maps = np.stack([one, -one, one, np.full((2, 2), 2.0)])
    truth = np.stack([one] * 4)
    table = _detector({"B_11": maps}, truth, scenes=["x", "x", "y", "y"])
    found = table.loc[table["measure"] == "pcc2", "value"].to_numpy()
    np.testing.assert_allclose(found, [0, -1, 0, np.nan], atol=1e-12)
    table = _detector({"B_11": maps}, truth, scenes=["x", "x", "y", "y"], other_scenes=True)
    found = table.loc[table["measure"] == "pcc2", "value"].to_numpy()
    np.testing.assert_allclose(found, [1, -1, 0, np.nan], atol=1e-12)


def test_a_wrong_number_of_names_is_refused():
    truth = _truth(2)
    with pytest.raises(ValueError, match="2 maps, 3 frame names"):
        detector_values({"B_11": truth}, FrameTargets(truth, truth, truth, list("abc"), list("ab")))


def _pattern(x, y):
    waves = np.random.default_rng(3).uniform(-0.4, 0.4, (6, 2))
    return sum(np.sin(a * x + b * y) for a, b in waves)


_U, _V = np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5)


def test_pcc3_and_pcc4_are_over_the_same_pixels():
    """The halves agree where both frames see the ground, even unmoved, and not outside: both measures are then 1."""
    down = np.array([[1.0, 0, 0], [0, 1, 20], [0, 0, 1]])
    lower = _pattern(_U, 0 * _V)
    seen = seen_in_second(lower.shape, down)
    assert 0.6 < seen.mean() < 0.75
    upper = np.where(seen, lower, np.random.default_rng(0).normal(0, 3, (64, 64)))
    values = _means(pair_values({"B_11": np.concatenate([upper, lower])[None]}, PairTargets([down], ["a"], ["s"])))
    assert values["pcc3"] == pytest.approx(1) and values["pcc4"] == pytest.approx(1)
    assert values["pcc4_minus_pcc3"] == pytest.approx(0)
    assert values["pcc3_all_pixels"] < 0.9 and values["pcc4_all_pixels"] < 0.9


def test_a_moved_pair_has_a_high_pcc4_and_constant_halves_have_none():
    homography = np.array([[1.1, 0.02, 3.0], [-0.01, 1.2, -6.0], [1e-4, -2e-4, 1]])
    x, y, w = (row[0] * _U + row[1] * _V + row[2] for row in homography)
    upper = _pattern(x / w, y / w)
    stacked = np.concatenate([upper, _pattern(_U, _V)])
    flat = np.concatenate([upper, np.full((64, 64), 0.5)])
    table = pair_values({"B_11": np.stack([stacked, flat])}, PairTargets([homography] * 2, ["a", "b"], ["s", "s"]))
    values = table.pivot(index="frame_id", columns="measure", values="value")
    assert values.loc["a", "pcc4"] > 0.99 and values.loc["a", "pcc3"] < 0.5
    assert values.loc["a", "pcc4_minus_pcc3"] == pytest.approx(values.loc["a", "pcc4"] - values.loc["a", "pcc3"])
    assert values.loc["b"].isna().all()
    assert (table["task"] == "navigate").all() and isinstance(table, pd.DataFrame)


def test_all_pixels_take_zero_outside_the_overlap():
    homography = np.array([[1.0, 0, 0], [0, 1, 20], [0, 0, 1]])
    upper, lower = _pattern(_U, _V) + 5, _pattern(_U, _V - 20) + 5
    moved = np.zeros((64, 64))
    moved[:44] = lower[20:]
    values = _means(
        pair_values({"B_11": np.concatenate([upper, lower])[None]}, PairTargets([homography], ["a"], ["s"]))
    )
    assert values["pcc4_all_pixels"] == pytest.approx(pearson(upper, moved))
    assert values["pcc3_all_pixels"] == pytest.approx(pearson(upper, lower))
    assert values["pcc4"] == pytest.approx(1)
