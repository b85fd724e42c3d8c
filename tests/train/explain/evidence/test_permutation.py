import numpy as np
import pytest

from perilune_train.explain.correlation.measures import FrameTargets, PairTargets, detector_values, pair_values
from perilune_train.explain.evidence.permutation import detector_permutations, pair_permutations, permuted

_SCENES = [f"s{n}" for n in range(6) for _ in range(2)]
_NAMES = [f"{scene}/t/{n}" for n, scene in enumerate(_SCENES)]


def test_p_is_small_for_a_mask_that_follows_its_own_scene():
    rng = np.random.default_rng(3)
    scene = np.repeat(np.arange(6), 2)
    follows = 0.5 * np.equal.outer(scene, scene) + 0.05 * rng.standard_normal((12, 12))
    # Only the identity, 1 of 720 permutations, reaches the observed mean.
    mean, p = permuted(follows, _SCENES, rng, 999)
    assert p < 0.01
    assert mean == pytest.approx(0.5 / 6, abs=0.03)
    assert permuted(-follows, _SCENES, rng, 999)[1] == pytest.approx(1)
    follows[0] = np.nan
    assert permuted(follows, _SCENES, rng, 999)[1] < 0.01
    assert np.isnan(permuted(np.full((12, 12), np.nan), _SCENES, rng)).all()


def test_p_with_two_scenes_is_a_half_at_least():
    correlations = np.array([[1.0, 0], [0, 1]])
    assert permuted(correlations, ["a", "b"], np.random.default_rng(0), 999)[1] == pytest.approx(0.5, abs=0.06)


def test_p_is_uniform_without_a_relation():
    rng = np.random.default_rng(4)
    scenes = [f"s{n}" for n in range(8)]
    found = [permuted(rng.standard_normal((8, 8)), scenes, rng, 39)[1] for _ in range(200)]
    assert np.mean(np.array(found) < 0.051) == pytest.approx(0.05, abs=0.05)
    assert np.mean(found) == pytest.approx(0.5, abs=0.06)


def test_detector_rows_have_the_values_of_the_gates_and_find_the_one_that_follows_craters():
    rng = np.random.default_rng(5)
    truth = (rng.random((12, 32, 32)) < 0.7).astype(np.float32)
    targets = FrameTargets(truth, *rng.random((2, 12, 32, 32)), _NAMES, _SCENES)
    masks = {"B_11": 1 - truth + 0.5 * rng.random(truth.shape), "B_21": rng.random(truth.shape)}
    values = detector_values(masks, targets)
    signs = {("detect", measure, gate): 1.0 for measure in ("pcc1_craterness", "pcc1_partial") for gate in masks}
    rows = detector_permutations(masks, targets, signs, rng).set_index(["measure", "map"])
    means = values.groupby(["measure", "map"])["value"].mean()
    for key, row in rows.iterrows():
        assert row["value"] == pytest.approx(means[key], abs=1e-9)
    assert rows["p"]["pcc1_craterness", "B_11"] < 0.01 < rows["p"]["pcc1_craterness", "B_21"]
    assert abs(rows["null_value"]["pcc1_craterness", "B_11"]) < 0.2
    negative = detector_permutations(masks, targets, {key: -1.0 for key in signs}, rng)
    assert negative["p"].iloc[0] > 0.9


def test_pair_rows_find_halves_that_show_the_same_ground():
    rng = np.random.default_rng(6)
    rough = rng.random((12, 8, 8)).repeat(16, axis=1).repeat(16, axis=2)
    moved = np.roll(rough, 16, axis=2)
    masks = {"same": np.concatenate([rough, moved], axis=1), "other": rng.random((12, 256, 128))}
    homographies = [np.array([[1.0, 0, 16], [0, 1, 0], [0, 0, 1]])] * 12
    targets = PairTargets(homographies, _NAMES, _SCENES)
    rows = pair_permutations(masks, targets, rng).set_index(["measure", "map"])
    assert rows["value"]["pcc4", "same"] > 0.95
    assert rows["p"]["pcc4", "same"] < 0.01 < rows["p"]["pcc4", "other"]
    assert abs(rows["null_value"]["pcc4", "same"]) < 0.2
    exact = pair_values(masks, targets)
    exact = exact[(exact["measure"] == "pcc3") & (exact["map"] == "same")]["value"].mean()
    assert rows["value"]["pcc3", "same"] == pytest.approx(exact, abs=0.03)


def test_fewer_than_five_scenes_have_no_p():
    rng = np.random.default_rng(7)
    masks = {"B_11": rng.random((4, 64, 32))}
    rows = pair_permutations(masks, PairTargets([np.eye(3)] * 4, list("abcd"), list("abcd")), rng)
    assert rows["p"].isna().all()
