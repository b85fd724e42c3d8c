"""Claims on what the masks correlate with, and on where they are large."""

import math

import numpy as np
import pandas as pd

from perilune_train.explain.evidence.significance import BEATS, LEVEL, UNDECIDED, unit_sign_flip_p
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.page.claim import Claim, decided, interval_text, row_of, scenes_of

STILL_FROM = 37
"""The paper: PCC4 is above PCC3 up to B_36, below from B_37."""
DEEP_GATES = tuple(f"B_4{k}" for k in (8,)) + tuple(f"B_5{k}" for k in (1, 2, 3, 4))
DEEP_ALIKE = 0.75
LOCALISATION = {"auc": "ROC-AUC", "relevance_mass": "relevance mass", "pointing": "pointing game"}
"""Measures of localisation and their names."""


def against_nulls(found: Evidence, measure: str, gate: str, claim: str, picture: str) -> Claim:
    """Whether a gate beats every null in a measure."""
    row = row_of(found, measure, gate)
    tested = found.tested[(found.tested["measure"] == measure) & (found.tested["map"] == gate)]
    verdict = "undefined: no null has a value" if tested.empty else str(tested.iloc[0]["verdict"])
    verdict = f"holds: {BEATS}" if verdict == BEATS else verdict
    figure = f"{row['value']:.2f}" if math.isfinite(row["value"]) else "-"
    return Claim(claim, figure, interval_text(row), null_means(found, measure, gate), verdict, picture)


def null_means(found: Evidence, measure: str, gate: str) -> str:
    """The mean of each null of a gate; a null whose map is constant in every image is undefined and not tested."""
    own = found.differences[(found.differences["measure"] == measure) & (found.differences["map"] == gate)]
    texts = [f"{row.null} {row.null_value:.2f}" for row in own.itertuples()]
    values = found.values[(found.values["measure"] == measure) & (found.values["map"] == f"untrained/{gate}")]
    if len(values) and values["value"].isna().all():
        texts.append("untrained undefined (constant, not tested)")
    return ", ".join(texts)


def shallow(found: Evidence) -> Claim:
    """Whether each stage up to stride 8 has a gate that follows craters and beats every null."""
    own = found.tested[(found.tested["measure"] == "pcc1_craterness")]
    some = own[own["map"].str[2].isin(["1", "2", "3"])]
    beating = beating_gates(found, "pcc1_craterness")
    stages = [str(k) for k in (1, 2, 3) if any(block[2] == str(k) for block in beating)]
    undecided = bool(some["verdict"].str.startswith("undecided").any())
    return Claim(
        "Detector: every stage up to stride 8 has a gate that beats every null (paper: shallow gates follow craters)",
        f"{len(beating)} of {len(some)} gates, stages {', '.join(stages) or 'none'}",
        "by gate in pcc_detect.png",
        f"untrained, edge, contrast, brightness, other frame, permutation; Benjamini-Hochberg over {len(own)} gates",
        UNDECIDED if undecided else "holds" if len(stages) == 3 else "does not hold",
        "pcc_detect.png",
    )


def beating_gates(found: Evidence, measure: str, stages: str = "123") -> list[str]:
    """Gates of some stages that beat every null in a measure, corrected for the number of gates."""
    own = found.tested[(found.tested["measure"] == measure) & found.tested["beats_all"]]
    return own.loc[own["map"].str[2].isin(list(stages)), "map"].tolist()


def deep_alike(found: Evidence) -> Claim:
    """The paper's claim that deep masks of two frames are alike."""
    gates = [gate for gate in DEEP_GATES if gate in set(found.summary["map"])]
    rows = [row_of(found, "pcc2", gate) for gate in gates]
    values = [float(row["value"]) for row in rows]
    untrained = [_null_value(found, "pcc2", gate, "untrained") for gate in gates]
    holds = all(value > DEEP_ALIKE for value in values)
    trivial = holds and all(value > DEEP_ALIKE for value in untrained)
    verdict = decided(holds, scenes_of(pd.DataFrame(rows)))
    verdict = "holds, as in the untrained network" if verdict == "holds" and trivial else verdict
    return Claim(
        f"Paper: PCC2 of {', '.join(gates)} is above {DEEP_ALIKE}",
        ", ".join(f"{value:.2f}" for value in values),
        "; ".join(interval_text(row) for row in rows),
        "untrained " + ", ".join(f"{value:.2f}" for value in untrained),
        verdict,
        "pcc_detect.png",
    )


def _null_value(found: Evidence, measure: str, gate: str, null: str) -> float:
    own = found.differences
    own = own[(own["measure"] == measure) & (own["map"] == gate) & (own["null"] == null)]
    return float(own["null_value"].iloc[0]) if len(own) else float("nan")


def located(found: Evidence, measure: str) -> Claim:
    """Whether the strongest gate locates craters better than its nulls and than attribution methods.

    A method is compared over the frames that have its map, paired, by sign flips of whole scenes. With fewer than five
    such scenes the comparison is undecided.
    """
    gate = found.strongest
    row = row_of(found, measure, gate)
    nulls = against_nulls(found, measure, gate, "", "")
    methods = found.summary.loc[
        (found.summary["measure"] == measure) & (found.summary["kind"] == "attribution"), "map"
    ].unique()
    compared = {str(name): _paired(found, measure, gate, str(name)) for name in methods}
    lost = [name for name, (_, p, _) in compared.items() if not p < LEVEL]
    least = min((scenes for _, _, scenes in compared.values()), default=scenes_of(row.to_frame().T))
    verdict = nulls.verdict
    if verdict.startswith("holds"):
        verdict = decided(not lost, least)
        if verdict == "does not hold":
            verdict += ": not better than " + ", ".join(lost)
    texts = [f"{name} {value:.2f} (p {p:.3f}, {scenes} scenes)" for name, (value, p, scenes) in compared.items()]
    chance = "0.50" if measure == "auc" else f"{row_of(found, f'{measure}_chance', gate)['value']:.2f}"
    return Claim(
        f"Detector: {gate} locates crater pixels better than nulls and attribution methods ({LOCALISATION[measure]})",
        f"{row['value']:.2f}",
        interval_text(row),
        ", ".join([f"chance {chance}", nulls.nulls, *texts]),
        verdict,
        "localisation_detect.png",
    )


def _paired(found: Evidence, measure: str, gate: str, name: str) -> tuple[float, float, int]:
    """Of an attribution method: its mean, p of "the gate is better" over the same frames, and the number of scenes."""
    own = found.values[found.values["measure"] == measure]
    table = own[own["map"].isin([gate, name])].pivot_table(
        index=["scene_id", "frame_id"], columns="map", values="value", aggfunc="first"
    )
    if name not in table or gate not in table:
        return math.nan, math.nan, 0
    table = table.dropna()
    by_scene = (table[gate] - table[name]).groupby(level="scene_id").mean().to_numpy(np.float64)
    return float(table[name].mean()), unit_sign_flip_p(by_scene), len(by_scene)


def motion(found: Evidence, *, moving: bool) -> Claim:
    """PCC4 - PCC3 of the gates up to B_36, or of those from B_37 on, beside the nulls of the same gates."""
    own = found.summary[(found.summary["measure"] == "pcc4_minus_pcc3") & (found.summary["kind"] == "gate")]
    number = own["map"].str[2:].astype(int)
    own = own[number < STILL_FROM] if moving else own[number >= STILL_FROM]
    fit = own["value"] > 0 if moving else own["value"] < 0
    nulls = found.differences[
        (found.differences["measure"] == "pcc4_minus_pcc3") & found.differences["map"].isin(own["map"])
    ]
    medians = nulls.groupby("null", sort=False)["null_value"].median()
    verdict = decided(bool(fit.all()), scenes_of(own))
    figure = f"{int(fit.sum())} of {len(own)} gates; median difference {own['value'].median():.2f}"
    if moving:
        tested = found.tested[(found.tested["measure"] == "pcc4_minus_pcc3") & found.tested["map"].isin(own["map"])]
        beating = int(tested["beats_all"].sum())
        figure += f"; {beating} beat every null"
        if verdict == "holds" and beating < len(own):
            verdict = f"holds, but {len(own) - beating} of {len(own)} gates do not beat every null"
    return Claim(
        f"Paper: PCC4 is {'above' if moving else 'below'} PCC3 {'up to B_36' if moving else 'from B_37 on'}",
        figure,
        "by gate in pcc_navigate.png",
        "medians over these gates: " + ", ".join(f"{null} {value:.2f}" for null, value in medians.items())
        if len(medians)
        else "-",
        verdict,
        "pcc_navigate.png",
    )
