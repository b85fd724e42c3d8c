"""Verdicts on tables where the answer is known, over enough scenes for one."""

from collections import defaultdict

import numpy as np
import pandas as pd
import pytest

from perilune_train.explain.evidence.gates import ALL
from perilune_train.explain.evidence.significance import against_nulls, null_differences, summary
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.page.claims import detector_claims, headline, navigator_claims

_SCENES = 8
_PER_SCENE = 3


def _values(task, measure, means, kinds=None, spread=0.02, only_scenes=_SCENES):
    """Long table of maps with a mean each; maps that are attributions have values in some scenes only."""
    rng, rows = np.random.default_rng(1), []
    for name, mean in means.items():
        kind = (kinds or {}).get(name, "gate" if name.startswith("B_") else "null")
        for scene in range(only_scenes if kind == "attribution" else _SCENES):
            for frame in range(_PER_SCENE):
                one = {"task": task, "kind": kind, "map": name, "measure": measure}
                one |= {"frame_id": f"s{scene}/t/{frame}", "scene_id": f"s{scene}"}
                rows.append(one | {"value": mean + rng.normal(0, spread)})
    return pd.DataFrame(rows)


def _interventions(harm, edges):
    """Forced gates lose `harm` of a performance of 1 in each scene; removed pixels lose 0.4, of edges `edges`."""
    forced, removed = [], []
    for scene in range(_SCENES):
        place = {"frame_id": f"s{scene}/t/0", "scene_id": f"s{scene}", "before": 1.0}
        forced += [{"scope": scope, **place, "after": 1.0 - harm[scene]} for scope in ("B_11", "stage 1", ALL)]
        for name, most in (("B_11", 0.4), ("edge/stage_1", edges), ("craters", 0.5)):
            losses = {"most": most} | ({"random": 0.1, "shifted": 0.05, "least": 0.0} if name != "edge/stage_1" else {})
            removed += [
                {"map": name, "which": k, "how": how, **place, "after": 1 - v, "overlap": 0.2}
                for how in ("inpaint", "mean")
                for k, v in losses.items()
            ]
    return pd.DataFrame(forced), pd.DataFrame(removed)


def _evidence(values, harm=(0.1,) * _SCENES, edges=0.3):
    rng = np.random.default_rng(0)
    signs = defaultdict(lambda: 1.0)
    pcc1 = values.loc[values["measure"].str.startswith("pcc1"), ["task", "measure", "map"]]
    known = dict.fromkeys(map(tuple, pcc1.to_numpy()), 1.0)
    tested = values[~values["measure"].str.endswith("_chance")]
    differences = null_differences(tested, known | signs, rng)
    forced, removed = _interventions(harm, edges)
    empty = pd.DataFrame()
    return Evidence(
        values, summary(values, rng), differences, against_nulls(differences), forced, removed, empty, empty, {}, "B_11"
    )


def _detector(craterness=0.6, methods=0.6, only_scenes=_SCENES, harm=(0.1,) * _SCENES, edges=0.3):
    parts = []
    for measure, gate, null in (
        ("pcc1_craterness", craterness, 0.3),
        ("pcc1_partial", craterness, 0.3),
        ("pcc2", 0.5, 0.2),
        ("auc", 0.8, 0.6),
        ("relevance_mass", 0.4, 0.3),
        ("pointing", 0.9, 0.5),
        ("relevance_mass_chance", 0.2, 0.2),
        ("pointing_chance", 0.3, 0.3),
    ):
        means = {"B_11": gate, "B_22": gate, "B_38": gate, "B_54": 0.0, "edge": null, "untrained/B_54": null}
        kinds = {}
        if measure in ("auc", "relevance_mass", "pointing"):
            means["grad_cam"], kinds["grad_cam"] = methods, "attribution"
        parts.append(_values("detect", measure, means, kinds, only_scenes=only_scenes))
    found = _evidence(pd.concat(parts, ignore_index=True), harm, edges)
    return {one.claim: one for one in detector_claims(found, {"B_11": 0.3})}


def _navigator(moving):
    means = {"B_11": moving, "B_22": moving, "B_48": -0.1}
    nulls = {f"edge/{gate}": value for gate, value in {"B_11": 0.6, "B_22": 0.4, "B_48": 0.1}.items()}
    parts = [
        _values("navigate", "pcc4_minus_pcc3", means | nulls),
        _values("navigate", "pcc4", {"B_11": 0.9, "edge": 0.5}),
    ]
    found = _evidence(pd.concat(parts, ignore_index=True))
    return navigator_claims(found, {"B_11": 0.3})


def _of(claims, text):
    found = [one for name, one in claims.items() if text in name]
    assert len(found) == 1
    return found[0]


def test_a_strong_gate_holds_and_one_like_an_edge_map_does_not():
    assert _of(_detector(), "follows craters beyond").verdict == "holds: beats every null"
    assert _of(_detector(0.3), "follows craters beyond").verdict == "does not beat: edge"


def test_nulls_of_a_claim_are_those_of_its_own_gates():
    """The edge map of B_48 must not pull down that of the gates up to B_36."""
    claims = _navigator(0.2)
    above = next(one for one in claims if "above PCC3 up to B_36" in one.claim)
    assert above.nulls == "medians over these gates: edge 0.50"
    assert above.figure.endswith("0 beat every null")
    assert above.verdict == "holds, but 2 of 2 gates do not beat every null"
    better = next(one for one in _navigator(0.8) if "above PCC3 up to B_36" in one.claim)
    assert (better.verdict, better.figure) == ("holds", "2 of 2 gates; median difference 0.80; 2 beat every null")
    below = next(one for one in claims if "below PCC3 from B_37" in one.claim)
    assert below.verdict == "holds" and below.nulls.endswith("edge 0.10")


def test_attribution_methods_are_compared_over_the_same_frames_and_enough_scenes():
    assert _of(_detector(methods=0.35), "ROC-AUC").verdict == "holds"
    assert _of(_detector(methods=0.35), "relevance mass").verdict == "holds"
    # 0.6 is above the relevance mass of the gate, 0.4.
    assert _of(_detector(methods=0.6), "relevance mass").verdict == "does not hold: not better than grad_cam"
    few = _of(_detector(methods=0.35, only_scenes=4), "ROC-AUC")
    assert few.verdict.startswith("undecided") and "4 scenes" in few.nulls


@pytest.mark.parametrize(
    ("harm", "verdict"),
    [
        ((0.1,) * 8, "holds"),
        ((-0.4,) * 7 + (np.nan,), "does not hold"),
        ((0.1, -0.1) * 4, "does not hold"),
        ((0.1,) * 4 + (np.nan,) * 4, "undecided: fewer than 5 scenes"),
    ],
)
def test_forced_gates_count_scenes_with_a_value(harm, verdict):
    claim = _of(_detector(harm=harm), "pattern of the masks matters")
    assert claim.verdict == verdict and "nan" not in claim.interval


def test_claims_on_what_is_used_come_first():
    for claims in (list(_detector().values()), _navigator(0.2)):
        words = ["the pattern of the masks matters", "the pattern of a single mask matters", "removing the 20 %"]
        assert [word in one.claim for word, one in zip(words, claims, strict=False)] == [True] * 3
        assert claims[3].picture.startswith("pcc_")


def test_a_single_gate_that_matters_is_counted_and_listed():
    claim = _of(_detector(), "a single mask")
    assert (claim.figure, claim.verdict) == ("1 of 1 gates; largest harm 0.100 (B_11)", "holds")
    assert claim.interval == "0.100 to 0.100 (8 units: scene)" and claim.nulls == "B_11 0.100 (p 0.0039)"
    nothing = _of(_detector(harm=(0.1, -0.1) * 4), "a single mask")
    assert nothing.verdict == "does not hold" and nothing.figure.startswith("0 of 1 gates")
    empty = _of(_detector(harm=(np.nan,) * 8), "a single mask")
    assert (empty.figure, empty.interval, empty.nulls) == ("0 of 1 gates", "none: no scene with a value", "-")


def test_removal_is_relative_to_controls_edges_and_a_perfect_mask():
    claim = _of(_detector(), "removing the 20 %")
    ratios = "4.00 times the stronger control, 1.33 times edges, 0.80 of what a perfect mask reaches"
    assert claim.figure == f"0.400: {ratios} (filled by inpaint, the less favourable)"
    assert claim.nulls.endswith("edges 0.300, perfect mask 0.500 (5.00 times its control)")
    assert claim.interval.endswith("(8 scenes)") and claim.verdict == "holds"
    assert _of(_detector(edges=0.45), "removing the 20 %").verdict == "does not beat: edges"


def test_the_headline_says_first_what_is_used():
    text = headline(list(_detector().values()) + _navigator(0.2))
    assert text.startswith(
        "Detector: the pattern of its masks matters: holds (harm 0.100); removing what it attends to"
    )
    assert "controls and edges: holds; the mask of B_11 follows craters: holds: beats every null. Navigator: " in text
    # Lower errors after a removal are no harm.
    assert "removing what it attends to hurts more than controls and edges: does not beat: control" in text
    assert headline(_navigator(0.2)[3:4]).startswith("Navigator: both halves of the mask")
