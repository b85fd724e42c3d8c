"""Verdicts of causal claims, on tables with a known effect."""

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.causal.claims import detection_claim, pose_claim, reaction_claim
from perilune_train.explain.causal.pictures import by_gate

_VIEWS = 8


def mask_table(n_scenes, rendered, placebo=0.0, seed=0):
    """Mask effects of B_11: means by version, one for all scenes or one for each, plus noise of views of 0.02."""
    rng, rows = np.random.default_rng(seed), []
    levels = {"rendered": rendered, "inpainted": rendered} | ({} if placebo is None else {"placebo": placebo})
    for version, level in levels.items():
        for scene, mean in enumerate(np.broadcast_to(level, n_scenes)):
            for view in range(_VIEWS):
                name = {"crater": scene * _VIEWS + view, "scene_id": f"s{scene}", "frame_id": f"s{scene}/{view}"}
                rows.append(name | {"map": "B_11", "version": version, "change": mean + rng.normal(0, 0.02)})
    return pd.DataFrame(rows)


def reaction(effects):
    rng = np.random.default_rng(0)
    return reaction_claim(effects, by_gate(effects, rng), "B_11")


def found_table(n_scenes, factual=0.9, rendered=0.0, placebo=0.9):
    """Detections: the share of each version is found in each scene of 20 views; a placebo of None is undefined."""
    rows = []
    for version, level in {"factual": factual, "rendered": rendered, "inpainted": 0.0, "placebo": placebo}.items():
        for scene, share in enumerate(np.broadcast_to(np.nan if level is None else level, n_scenes)):
            for view in range(20):
                name = {"crater": scene * 20 + view, "scene_id": f"s{scene}", "frame_id": f"s{scene}/{view}"}
                rows.append(name | {"version": version, "found": np.nan if level is None else float(view < 20 * share)})
    return pd.DataFrame(rows)


def pose_table(n_scenes, harm_m):
    rng, rows = np.random.default_rng(0), []
    for scene, mean in enumerate(np.broadcast_to(harm_m, n_scenes)):
        for step in range(_VIEWS):
            before = 2 + rng.normal(0, 0.1)
            after = before + mean + rng.normal(0, 0.01)
            name = {"frame_id": f"s{scene}/t0/{step}", "scene_id": f"s{scene}"}
            rows.append(name | {"before": before, "after": after, "moved_m": abs(after - before)})
    return pd.DataFrame(rows)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_gate_with_a_known_effect_reacts(sign):
    tested = reaction(mask_table(6, 0.5 * sign, -0.1))
    assert tested.claim["verdict"] == "holds"
    # All 2^6 flips, in both directions.
    assert tested.p == tested.p_placebo == pytest.approx(2 / 64)
    assert "6 scenes" in tested.claim["interval"] and "p 0.0312" in tested.claim["interval"]
    assert tested.claim["figure"] == f"{0.5 * sign:.2f}" and tested.claim["nulls"].startswith("crater inpainted")


def test_an_effect_of_random_sign_does_not_hold_although_its_views_agree_within_a_scene():
    tested = reaction(mask_table(8, [0.6, -0.4, 0.5, -0.5, 0.6, 0.5, -0.4, 0.4]))
    assert tested.claim["verdict"] == "does not hold" and tested.p > 0.3


def test_a_bootstrap_decides_nothing():
    """One scene of seven has the opposite sign: the interval of the bootstrap leaves out 0."""
    effects = mask_table(7, [0.5, 0.3, 0.6, 0.5, 0.6, 0.3, -0.4])
    low = by_gate(effects, np.random.default_rng(0)).iloc[0]["low"]
    tested = reaction(effects)
    assert low > 0 and tested.p > 0.05 and tested.claim["verdict"] == "does not hold"


@pytest.mark.parametrize("n_scenes", [1, 4, 5])
def test_few_scenes_are_undecided(n_scenes):
    # In both directions, five scenes have p of at least 2 / 32.
    tested = reaction(mask_table(n_scenes, 0.5))
    assert tested.claim["verdict"] == "undecided: fewer than 6 scenes" and np.isnan(tested.p)


@pytest.mark.parametrize("placebo", [0.5, -0.5, 0.8, -0.8])
def test_a_placebo_as_strong_as_the_crater_refutes_the_reaction(placebo):
    tested = reaction(mask_table(8, 0.5, placebo))
    assert tested.p < 0.05 < tested.p_placebo and tested.claim["verdict"] == "does not hold"


def test_without_a_placebo_nothing_holds():
    tested = reaction(mask_table(8, 0.5, None))
    assert tested.claim["verdict"] == "undecided: no placebo" and "empty ground inpainted none" in tested.claim["nulls"]
    effects = mask_table(8, 0.5)
    placebo = effects["version"] == "placebo"
    effects.loc[placebo, "change"] = np.nan
    assert reaction(effects).claim["verdict"] == "undecided: no placebo"
    effects.loc[placebo & (effects["scene_id"] < "s3"), "change"] = 0.0
    assert reaction(effects).claim["verdict"] == "undecided: fewer than 6 scenes with a placebo"


def test_views_without_a_value_are_left_out():
    effects = mask_table(7, 0.5)
    effects.loc[(effects["scene_id"] == "s0") | (effects["crater"] % 5 == 0), "change"] = np.nan
    tested = reaction(effects)
    assert tested.claim["verdict"] == "holds" and tested.p == pytest.approx(2 / 64)
    assert reaction(effects.assign(change=np.nan)).claim["verdict"].startswith("undecided")


def detected(table):
    return detection_claim(table, np.random.default_rng(0))


def test_a_crater_that_is_found_only_where_it_is_decides_the_detection():
    tested = detected(found_table(6))
    assert tested.claim["verdict"] == "holds" and tested.p == tested.p_placebo == pytest.approx(1 / 64)
    assert tested.claim["figure"] == "0.90 with, 0.00 without" and "p 0.0156" in tested.claim["interval"]


@pytest.mark.parametrize(
    ("shares", "verdict"),
    [
        # Found without it as often, in half of the scenes more often.
        ({"factual": [0.9, 0.5] * 4, "rendered": [0.5, 0.9] * 4}, "does not hold"),
        # Significant, but still found without it in a third of the views.
        ({"rendered": 0.3}, "does not hold"),
        # Filling other ground loses the crater as well.
        ({"placebo": 0.0}, "does not hold"),
        ({"placebo": None}, "undecided: no placebo"),
        ({"n_scenes": 4}, "undecided: fewer than 5 scenes"),
        ({"n_scenes": 5}, "holds"),
    ],
)
def test_verdicts_of_detections(shares, verdict):
    assert detected(found_table(**({"n_scenes": 8} | shares))).claim["verdict"] == verdict


@pytest.mark.parametrize(
    ("n_scenes", "harm_m", "verdict"),
    [
        (6, 0.3, "holds"),
        (6, -0.3, "does not hold"),
        (8, [0.3, -0.3, 0.3, -0.2, 0.2, -0.3, 0.3, -0.2], "does not hold"),
        (4, 0.3, "undecided: fewer than 5 scenes"),
        # The interval of the bootstrap leaves out 0.
        (6, [0.4, 0.3, 0.4, 0.3, 0.4, -0.35], "does not hold"),
    ],
)
def test_verdicts_of_poses(n_scenes, harm_m, verdict):
    tested = pose_claim(pose_table(n_scenes, harm_m), np.random.default_rng(0))
    assert tested.claim["verdict"] == verdict
    assert np.isnan(tested.p) if n_scenes < 5 else f"p {tested.p:.4f}" in tested.claim["interval"]


def test_steps_without_an_estimate_are_left_out():
    effects = pose_table(6, 0.3)
    effects.loc[[0, 3, 9], "after"] = np.nan
    assert pose_claim(effects, np.random.default_rng(0)).claim["verdict"] == "holds"
