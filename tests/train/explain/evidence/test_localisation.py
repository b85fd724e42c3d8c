"""Localisation measures against values by hand, and against scikit-learn and Quantus where they are installed."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.evidence.localisation import area_under_curve, localisation, localised, within


@pytest.fixture
def craters():
    mask = np.zeros((20, 20), bool)
    mask[4:6, 4:6] = True
    return mask


def test_relevance_mass_and_auc_by_hand():
    # Shifted to minimum 0: 3, 1 within the crater and 2, 0 outside. Of 4 pairs, 3 > 2, 3 > 0 and 1 > 0 are right.
    values = localised(np.array([[5.0, 3], [4, 2]]), np.array([[True, True], [False, False]]))
    assert values["relevance_mass"] == pytest.approx(4 / 6)
    assert values["auc"] == pytest.approx(3 / 4)
    assert values["relevance_mass_chance"] == 0.5


def test_ties_count_half_in_the_auc():
    # Pairs: 1 = 1 and 1 > 0 of two pairs.
    assert area_under_curve(np.array([1.0, 1, 0]), np.array([True, False, False])) == pytest.approx(0.75)


def test_the_pointing_game_has_a_tolerance_of_three_pixels(craters):
    for column, hit in ((5, 1), (8, 1), (9, 0)):
        relevance = np.zeros((20, 20))
        relevance[5, column] = 1
        assert localised(relevance, craters)["pointing"] == hit
    # Diagonally from pixel (5, 5): (7, 7) is 2.8 px away, (8, 8) 4.2 px.
    assert within(craters, 3)[7, 7] and not within(craters, 3)[8, 8]
    tied = np.zeros((20, 20))
    tied[5, 5] = tied[15, 15] = tied[15, 16] = 1
    assert localised(tied, craters)["pointing"] == pytest.approx(1 / 3)


def test_the_chance_of_pointing_is_that_of_random_maps():
    rng = np.random.default_rng(0)
    craters = np.zeros((16, 16), bool)
    craters[3, 3] = craters[10, 8:11] = True
    found = [localised(rng.random((16, 16)), craters) for _ in range(2000)]
    means = {name: np.mean([one[name] for one in found]) for name in found[0]}
    # The share of hits has a standard error of at most 0.5 / sqrt(2000) = 0.011.
    assert means["pointing"] == pytest.approx(means["pointing_chance"], abs=0.04)
    assert means["relevance_mass"] == pytest.approx(4 / 256, abs=0.001)
    assert means["auc"] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("case", ["constant", "none", "all"])
def test_what_is_undefined_is_nan(craters, case):
    relevance = np.full((20, 20), 2.0) if case == "constant" else np.random.default_rng(0).random((20, 20))
    inside = {"constant": craters, "none": np.zeros_like(craters), "all": np.ones_like(craters)}[case]
    assert all(np.isnan(value) for value in localised(relevance, inside).values())


def test_the_table_has_a_row_for_each_map_measure_and_frame(craters):
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.1, (2, 20, 20))
    maps = {"B_11": craters + noise, "B_21": noise - craters}
    frames = pd.DataFrame({"frame_id": ["a", "b"], "scene_id": ["s", "t"]}, index=[7, 9])
    table = localisation(maps, np.stack([craters, craters]), {"B_11": 1, "B_21": -1}, frames, "detect", "gate")
    assert list(table.columns) == ["task", "kind", "map", "measure", "frame_id", "scene_id", "value"]
    assert len(table) == 2 * 2 * 5
    values = table.set_index(["map", "measure", "frame_id"])["value"]
    # Both maps are the same but for the sign, which is undone.
    flipped = localisation({"B_21": -maps["B_21"]}, np.stack([craters] * 2), {"B_21": 1}, frames, "detect", "gate")
    np.testing.assert_allclose(values["B_21"], flipped.set_index(["map", "measure", "frame_id"])["value"]["B_21"])
    assert values["B_11", "auc", "a"] == pytest.approx(1) and values["B_11", "pointing", "b"] == 1
    assert set(table.loc[table["frame_id"] == "b", "scene_id"]) == {"t"}


def test_auc_equals_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(2)
    inside, relevance = rng.random((30, 40)) < 0.3, rng.integers(0, 20, (30, 40)) / 7
    expected = metrics.roc_auc_score(inside.ravel(), relevance.ravel())
    assert area_under_curve(relevance, inside) == pytest.approx(expected)


def test_measures_equal_quantus():
    quantus = pytest.importorskip("quantus")
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(3)
    inside = rng.random((4, 16, 16)) < 0.05
    relevance = rng.random((4, 16, 16))
    relevance -= relevance.min(axis=(1, 2), keepdims=True)
    inputs = {
        "model": torch.nn.Identity(),
        "x_batch": np.zeros((4, 1, 16, 16)),
        "y_batch": np.zeros(4, int),
        "a_batch": relevance[:, None],
    }
    plain = {"abs": False, "normalise": False, "disable_warnings": True}
    near = np.stack([within(one, 3) for one in inside])
    for name, metric, masks in (
        ("pointing", quantus.PointingGame(**plain), near),
        ("relevance_mass", quantus.RelevanceMassAccuracy(**plain), inside),
        ("auc", quantus.AUC(**plain), inside),
    ):
        found = [localised(*pair)[name] for pair in zip(relevance, inside, strict=True)]
        np.testing.assert_allclose(found, np.asarray(metric(**inputs, s_batch=masks[:, None]), float), rtol=1e-6)
