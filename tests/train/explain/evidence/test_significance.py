"""Intervals and verdicts on tables where the answer is known."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.evidence.significance import (
    BEATS,
    UNDECIDED,
    UNDEFINED,
    against_nulls,
    null_differences,
    pairwise,
    summary,
    unit_sign_flip_p,
    validation_signs,
)

_RNG_SEED = 11


def _table(values, measure="pcc1_craterness", scenes=10, per_scene=4, names=None):
    """The long table of maps with values (scenes x per_scene,); names without "B_" at the start are nulls."""
    ids = [f"s{s:02d}/t{f // 2}/{f:06d}" for s in range(scenes) for f in range(per_scene)]
    parts = []
    for name, found in values.items():
        columns = {"task": "detect", "kind": "gate" if name.startswith("B_") else "null", "map": name}
        columns |= {"measure": measure, "frame_id": ids, "scene_id": [one[:3] for one in ids], "value": found}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def _noisy(mean, scenes=10, per_scene=4, seed=0):
    rng = np.random.default_rng(seed)
    return mean + np.repeat(rng.normal(0, 0.02, scenes), per_scene) + rng.normal(0, 0.05, scenes * per_scene)


def _verdicts(table, signs=None):
    signs = validation_signs(table) if signs is None else signs
    return against_nulls(null_differences(table, signs, np.random.default_rng(_RNG_SEED))).set_index("map")


def test_summary_is_the_mean_with_an_interval_over_scenes():
    values = _noisy(0.4)
    values[3] = np.nan
    row = summary(_table({"B_11": values}), np.random.default_rng(0)).iloc[0]
    assert row["value"] == pytest.approx(np.nanmean(values))
    assert row["low"] < row["value"] < row["high"]
    assert (row["n_units"], row["unit"], row["undefined"], row["count"]) == (10, "scene", 1, 40)
    # The standard error over scenes is that of ten scene means.
    error = np.nanmean(values.reshape(10, 4), axis=1).std() / np.sqrt(10)
    assert row["high"] - row["low"] == pytest.approx(2 * 1.96 * error, rel=0.15)


def test_few_units_have_no_interval():
    table = summary(_table({"B_11": _noisy(0.4, 4)}, scenes=4), np.random.default_rng(0))
    assert table["n_units"].item() == 4 and table[["low", "high"]].isna().all(axis=None)
    # One scene: its trajectories are the units.
    one = summary(_table({"B_11": _noisy(0.4, 1, 12)}, scenes=1, per_scene=12), np.random.default_rng(0)).iloc[0]
    assert one["unit"] == "trajectory" and one["n_units"] == 6 and np.isfinite(one["low"])
    # Frames without a known trajectory are not units.
    alone = _table({"B_11": _noisy(0.4, 1, 12)}, scenes=1, per_scene=12)
    alone["frame_id"] = alone["frame_id"].str.rpartition("/")[2]
    alone = summary(alone, np.random.default_rng(0)).iloc[0]
    assert alone["unit"] == "image" and np.isnan(alone["low"])


def test_a_gate_that_follows_the_truth_beats_and_a_copy_of_the_edges_does_not():
    edge = _noisy(0.3, seed=1)
    nulls = {"edge/stage_1": edge, "other frame/B_11": _noisy(0.0, seed=2), "other frame/B_12": _noisy(0.0, seed=3)}
    found = _verdicts(_table({"B_11": _noisy(0.6), "B_12": edge.copy()} | nulls))
    assert found.loc["B_11", "verdict"] == BEATS and found.loc["B_11", "beats_all"]
    assert found.loc["B_12", "verdict"] == "does not beat: edge" and not found.loc["B_12", "beats_all"]
    # All ten scenes have a positive difference: p is 1 of the 2^10 sign flips, times 2 gates / rank 1.
    assert found.loc["B_11", "p"] == pytest.approx(2**-10)
    assert found.loc["B_11", "p_adjusted"] == pytest.approx(2 * 2**-10)


def test_nulls_apply_to_their_gate_or_stage():
    values = {name: _noisy(0.2, seed=n) for n, name in enumerate(["B_11", "B_31"])}
    values |= {name: _noisy(0.1) for name in ("edge/stage_3", "untrained/B_11", "chance")}
    differences = null_differences(_table(values, "pcc2"), {}, np.random.default_rng(0))
    pairs = set(zip(differences["map"], differences["null"], strict=True))
    assert pairs == {("B_11", "untrained"), ("B_11", "chance"), ("B_31", "edge"), ("B_31", "chance")}


def test_four_scenes_and_trajectories_of_one_scene_are_undecided():
    few = _verdicts(_table({"B_11": _noisy(0.9, 4), "edge": _noisy(0.0, 4, seed=1)}, scenes=4))
    assert few.loc["B_11", "verdict"] == UNDECIDED and not few.loc["B_11", "beats_all"]
    one = _verdicts(_table({"B_11": _noisy(0.9, 1, 20), "edge": _noisy(0.0, 1, 20, seed=1)}, scenes=1, per_scene=20))
    assert one.loc["B_11", "unit"] == "trajectory" and one.loc["B_11", "verdict"] == UNDECIDED


def test_a_constant_gate_is_undefined_and_an_undefined_null_is_left_out():
    values = {
        "B_11": np.full(40, np.nan),
        "B_12": _noisy(0.5),
        "edge": _noisy(0.1, seed=1),
        "flat": np.full(40, np.nan),
    }
    found = _verdicts(_table(values))
    assert found.loc["B_11", "verdict"] == UNDEFINED and found.loc["B_12", "verdict"] == BEATS


def test_a_gate_that_is_weaker_on_craters_is_compared_by_its_sign_on_validation_frames():
    values = {"B_11": _noisy(-0.6), "edge": _noisy(0.3, seed=1), "untrained/B_11": _noisy(-0.1, seed=2)}
    table = _table(values)
    signs = validation_signs(_table({name: 0.5 * one for name, one in values.items()}))
    assert signs["detect", "pcc1_craterness", "B_11"] == -1 and signs["detect", "pcc1_craterness", "edge"] == 1
    assert _verdicts(table, signs).loc["B_11", "beats_all"]
    # With the other sign on validation frames the test frames contradict it.
    wrong = signs | {("detect", "pcc1_craterness", "B_11"): 1.0}
    assert _verdicts(table, wrong).loc["B_11", "verdict"] == "does not beat: edge, untrained"
    with pytest.raises(ValueError, match="no sign of B_11"):
        null_differences(table, {}, np.random.default_rng(0))


def test_differences_are_paired_over_frames():
    common = np.random.default_rng(4).normal(0, 1, 40)
    table = _table({"B_11": common + 0.05, "edge": common}, "pcc4")
    row = null_differences(table, {}, np.random.default_rng(0)).iloc[0]
    assert row["difference"] == pytest.approx(0.05) and row["low"] == pytest.approx(0.05)
    assert row["p"] == pytest.approx(2**-10) and row["p_bootstrap"] == pytest.approx(1 / 1001)


def test_the_sign_flip_test_by_hand():
    # Scene sums 1, 2, 3, 4, -1 have the total 9. 3 of 32 flips reach it: of none, of -1, of 1 and -1.
    values = np.array([1.0, 2, 3, 4, -1])
    table = _table({"B_11": values, "edge": np.zeros(5)}, "pcc4", scenes=5, per_scene=1)
    assert null_differences(table, {}, np.random.default_rng(0))["p"].item() == pytest.approx(3 / 32)


def test_the_false_discovery_rate_under_a_global_null_is_near_five_percent():
    rng = np.random.default_rng(5)
    draws = []
    for draw in range(100):
        values = {f"B_3{k}": np.repeat(rng.normal(0, 0.1, 12), 2) + rng.normal(0, 0.02, 24) for k in range(1, 7)}
        draws.append(_table(values | {"chance": np.zeros(24)}, f"pcc2 of draw {draw}", scenes=12, per_scene=2))
    found = _verdicts(pd.concat(draws), {}).groupby("measure")["beats_all"].any()
    assert len(found) == 100
    # Three standard errors of a rate of 5 % in 100 draws are 0.065.
    assert np.mean(found) <= 0.05 + 0.065


def test_two_values_of_one_frame_are_refused():
    table = _table({"B_11": _noisy(0.5)})
    with pytest.raises(ValueError, match="two values of one frame for B_11, pcc1_craterness"):
        summary(pd.concat([table, table]), np.random.default_rng(0))


def test_sign_flips_of_units_by_hand():
    # Of eight flips only the observed one reaches the sum.
    assert unit_sign_flip_p(np.array([1.0, 2.0, 3.0])) == pytest.approx(1 / 8)
    assert unit_sign_flip_p(np.array([1.0, 2.0, -4.0])) == pytest.approx(5 / 8)
    assert unit_sign_flip_p(np.full(20, 1.0)) == pytest.approx(1 / 4096)


def test_units_without_a_value_are_left_out_of_the_sign_flips():
    values = np.array([0.1, -0.5, -0.3, -0.2, -0.4])
    assert unit_sign_flip_p(np.insert(values, 3, np.nan)) == unit_sign_flip_p(values) > 0.5
    assert np.isnan(unit_sign_flip_p(np.array([np.nan])))


def test_intervals_of_means_over_pairs_of_frames_cover_the_truth():
    """Frames n and m of scenes a and b correlate by x_a + x_b: the mean over all pairs is 2 E[x]."""
    rng, inside, narrow, scenes, per_scene = np.random.default_rng(3), 0, 0, 12, 3
    for _ in range(60):
        x = np.repeat(rng.normal(0.2, 0.1, scenes), per_scene)
        both = x[:, None] + x[None]
        np.fill_diagonal(both, np.nan)
        values = np.nanmean(both, axis=1)
        found = [
            summary(_table({"B_11": values}, measure, scenes, per_scene), rng).iloc[0]
            for measure in ("pcc2", "pcc1_craterness")
        ]
        assert found[0]["value"] == pytest.approx(values.mean())
        inside += found[0]["low"] <= 0.4 <= found[0]["high"]
        narrow += found[1]["low"] <= 0.4 <= found[1]["high"]
    # A bootstrap over 12 units covers about 91 %; as independent values the same frames cover about 60 %.
    assert inside >= 50 > 45 > narrow


def test_pairs_keep_their_mean_in_tests_against_nulls():
    values = np.array([0.1, 0.3, np.nan, 0.5])
    assert np.nanmean(pairwise("pcc2", values)) == pytest.approx(0.3)
    assert pairwise("pcc4", values) is values
