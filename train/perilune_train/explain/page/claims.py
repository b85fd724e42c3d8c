"""Claims about attention gates, each with figure, interval, nulls, verdict and picture."""

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from scipy.stats import false_discovery_control

from perilune_train.explain.evidence.gates import ALL, forced_summary
from perilune_train.explain.evidence.removal import PERFECT, Relative, relative_harm, removal_summary
from perilune_train.explain.evidence.significance import BEATS, LEVEL, UNDECIDED, unit_sign_flip_p
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.records.spread import MIN_UNITS

MIN_DEVIATION = 0.02
"""Smallest standard deviation, over pixels and images, at which a mask does not count as constant."""
_FORCES = "the pattern of the masks matters"
"""Words by which `headline` recognises the claim on all forced gates."""
_REMOVES = "removing the 20 %"
"""Words by which `headline` recognises the claim on removed pixels."""
_LOOKS = ("follows craters", "mark the same ground")
"""Words by which `headline` recognises the first claim on what the strongest mask looks like."""
STILL_FROM = 37
"""Number of the gate B_37. The paper states that PCC4 is above PCC3 up to B_36, and below PCC3 from B_37 on."""
DEEP_GATES = tuple(f"B_4{k}" for k in (8,)) + tuple(f"B_5{k}" for k in (1, 2, 3, 4))
"""Gates for which the paper reports a PCC2 above `DEEP_ALIKE`."""
DEEP_ALIKE = 0.75
LOCALISATION = {"auc": "ROC-AUC", "relevance_mass": "relevance mass", "pointing": "pointing game"}
"""Localisation measures and their display names."""
_LISTED_GATES = 5
"""Largest number of gates whose harms a claim lists."""


@dataclass(frozen=True)
class Claim:
    """One statement and its verdict; all fields are texts for a table."""

    claim: str
    """The statement, with "Paper:" in front if the paper states it."""
    figure: str
    """The measured figure."""
    interval: str
    """The 95 % interval over scenes, or the reason why there is no interval."""
    nulls: str
    """The figures of the nulls or controls."""
    verdict: str
    """holds, does not hold, or undecided, with the reason."""
    picture: str
    """File name of the picture that shows the figure."""

    def plain(self) -> dict[str, str]:
        """The fields as plain data."""
        return asdict(self)


def decided(holds: bool, scenes: int) -> str:
    """The verdict "holds" or "does not hold"; undecided with fewer than five scenes."""
    return UNDECIDED if scenes < MIN_UNITS else "holds" if holds else "does not hold"


def row_of(evidence: Evidence, measure: str, name: str) -> pd.Series:
    """The row of the summary for a measure and the map `name`."""
    rows = evidence.summary[(evidence.summary["measure"] == measure) & (evidence.summary["map"] == name)]
    return rows.iloc[0]


def interval_text(row: pd.Series, decimals: int = 2) -> str:
    """The interval of a row of the summary and its number of units, as text; "none" without an interval."""
    if math.isfinite(row["low"]) and math.isfinite(row["high"]):
        return f"{row['low']:.{decimals}f} to {row['high']:.{decimals}f} ({row['n_units']} units: {row['unit']})"
    return f"none: {row['n_units']} units ({row['unit']})"


def scenes_of(rows: pd.DataFrame) -> int:
    """The smallest number of scenes in rows of a summary; 1 if the units are not scenes."""
    return int(rows["n_units"].min()) if len(rows) and (rows["unit"] == "scene").all() else 1


def detector_claims(evidence: Evidence, deviations: dict[str, float], guided: Collection[str] = ()) -> list[Claim]:
    """Claims about the detector: first what it uses, then what its masks look like.

    `deviations` are the standard deviations of the masks over pixels and images. `guided` are gates whose masks were
    trained to follow labels; claims on these gates say so.
    """
    strongest = evidence.strongest
    follows = f"Detector: the mask of {strongest} follows craters"
    trained = ", as it was trained to" if strongest in guided else ""
    beyond = f"{follows} beyond brightness and gradient{trained}"
    unit = "AP of a frame"
    return [
        forced_claim(evidence, "Detector", unit, "gates_detect.png", higher_is_better=True),
        single_gate_claim(evidence, "Detector", unit, "gates_detect.png", higher_is_better=True),
        removal_claim(evidence, "Detector", unit, "removal_detect.png", higher_is_better=True),
        against_nulls(evidence, "pcc1_craterness", strongest, follows + trained, "pcc_detect.png"),
        against_nulls(evidence, "pcc1_partial", strongest, beyond, "pcc_detect.png"),
        shallow(evidence),
        deep_alike(evidence),
        *(located(evidence, measure) for measure in LOCALISATION),
        _constant("Detector", deviations, "masks_detect.png"),
    ]


def navigator_claims(evidence: Evidence, deviations: dict[str, float]) -> list[Claim]:
    """Claims about the stack navigator: first what it uses, then what its masks look like.

    `deviations` are the standard deviations of the masks.
    """
    strongest, unit = evidence.strongest, "position error of a pair, m"
    alike = f"Navigator: both halves of the mask of {strongest} mark the same ground (PCC4)"
    return [
        forced_claim(evidence, "Navigator", unit, "gates_navigate.png", higher_is_better=False),
        single_gate_claim(evidence, "Navigator", unit, "gates_navigate.png", higher_is_better=False),
        removal_claim(evidence, "Navigator", unit, "removal_navigate.png", higher_is_better=False),
        against_nulls(evidence, "pcc4", strongest, alike, "pcc_navigate.png"),
        motion(evidence, moving=True),
        motion(evidence, moving=False),
        _constant("Navigator", deviations, "masks_navigate.png"),
    ]


def headline(claims: list[Claim]) -> str:
    """One sentence for each network: what its output uses, then what its strongest mask looks like."""
    sentences = []
    for task in ("Detector", "Navigator"):
        of_task = [claim for claim in claims if claim.claim.startswith(task)]
        forced, removed = (next((one for one in of_task if words in one.claim), None) for words in (_FORCES, _REMOVES))
        looks = next((one for one in of_task if any(words in one.claim for words in _LOOKS)), None)
        parts = [f"the pattern of its masks matters: {forced.verdict} ({forced.figure})"] if forced else []
        parts += (
            [f"removing what it attends to hurts more than controls and edges: {removed.verdict}"] if removed else []
        )
        parts += [f"{looks.claim[len(task) + 2 :]}: {looks.verdict}"] if looks else []
        sentences += [f"{task}: {'; '.join(parts)}."] if parts else []
    return " ".join(sentences)


def _constant(task: str, deviations: dict[str, float], picture: str) -> Claim:
    least = min(deviations, key=lambda block: deviations[block])
    constant = [block for block, value in deviations.items() if value < MIN_DEVIATION]
    return Claim(
        f"{task}: no gate is constant (standard deviation over pixels and images at least {MIN_DEVIATION:g})",
        f"{len(constant)} of {len(deviations)} constant; least {deviations[least]:.3f} ({least})",
        "-",
        "-",
        "does not hold" if constant else "holds",
        picture,
    )


def against_nulls(evidence: Evidence, measure: str, gate: str, claim: str, picture: str) -> Claim:
    """A claim about one gate, with the verdict whether the gate beats every null in a measure."""
    row = row_of(evidence, measure, gate)
    tested = evidence.tested[(evidence.tested["measure"] == measure) & (evidence.tested["map"] == gate)]
    verdict = "undefined: no null has a value" if tested.empty else str(tested.iloc[0]["verdict"])
    verdict = f"holds: {BEATS}" if verdict == BEATS else verdict
    figure = f"{row['value']:.2f}" if math.isfinite(row["value"]) else "-"
    return Claim(claim, figure, interval_text(row), null_means(evidence, measure, gate), verdict, picture)


def null_means(evidence: Evidence, measure: str, gate: str) -> str:
    """Means of a gate's nulls, as text. A null is undefined and not tested if its map is constant in every image."""
    rows = evidence.differences[(evidence.differences["measure"] == measure) & (evidence.differences["map"] == gate)]
    texts = [f"{row.null} {row.null_value:.2f}" for row in rows.itertuples()]
    values = evidence.values[(evidence.values["measure"] == measure) & (evidence.values["map"] == f"untrained/{gate}")]
    if len(values) and values["value"].isna().all():
        texts.append("untrained undefined (constant, not tested)")
    return ", ".join(texts)


def shallow(evidence: Evidence) -> Claim:
    """The claim that every stage up to stride 8 has a gate that follows craters and beats every null."""
    tested = evidence.tested[(evidence.tested["measure"] == "pcc1_craterness")]
    shallow_gates = tested[tested["map"].str[2].isin(["1", "2", "3"])]
    beating = beating_gates(evidence, "pcc1_craterness")
    stages = [str(k) for k in (1, 2, 3) if any(block[2] == str(k) for block in beating)]
    undecided = bool(shallow_gates["verdict"].str.startswith("undecided").any())
    return Claim(
        "Detector: every stage up to stride 8 has a gate that beats every null (paper: shallow gates follow craters)",
        f"{len(beating)} of {len(shallow_gates)} gates, stages {', '.join(stages) or 'none'}",
        "by gate in pcc_detect.png",
        f"untrained, edge, contrast, brightness, other frame, permutation; Benjamini-Hochberg over {len(tested)} gates",
        UNDECIDED if undecided else "holds" if len(stages) == 3 else "does not hold",
        "pcc_detect.png",
    )


def beating_gates(evidence: Evidence, measure: str, stages: str = "123") -> list[str]:
    """Gates of the given stages that beat every null in a measure, after correction for the number of gates."""
    rows = evidence.tested[(evidence.tested["measure"] == measure) & evidence.tested["beats_all"]]
    return rows.loc[rows["map"].str[2].isin(list(stages)), "map"].tolist()


def deep_alike(evidence: Evidence) -> Claim:
    """The paper's claim that the deep masks of different frames are similar."""
    gates = [gate for gate in DEEP_GATES if gate in set(evidence.summary["map"])]
    rows = [row_of(evidence, "pcc2", gate) for gate in gates]
    values = [float(row["value"]) for row in rows]
    untrained = [_null_value(evidence, "pcc2", gate, "untrained") for gate in gates]
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


def _null_value(evidence: Evidence, measure: str, gate: str, null: str) -> float:
    rows = evidence.differences
    rows = rows[(rows["measure"] == measure) & (rows["map"] == gate) & (rows["null"] == null)]
    return float(rows["null_value"].iloc[0]) if len(rows) else float("nan")


def located(evidence: Evidence, measure: str) -> Claim:
    """The claim that the strongest gate locates craters better than its nulls and the attribution methods.

    The gate is compared with each method on the frames that have the method's map, by a paired sign-flip test over
    scenes. The comparison is undecided with fewer than five scenes.
    """
    gate = evidence.strongest
    row = row_of(evidence, measure, gate)
    nulls = against_nulls(evidence, measure, gate, "", "")
    methods = evidence.summary.loc[
        (evidence.summary["measure"] == measure) & (evidence.summary["kind"] == "attribution"), "map"
    ].unique()
    compared = {str(name): _paired(evidence, measure, gate, str(name)) for name in methods}
    lost = [name for name, (_, p, _) in compared.items() if not p < LEVEL]
    least = min((scenes for _, _, scenes in compared.values()), default=scenes_of(row.to_frame().T))
    verdict = nulls.verdict
    if verdict.startswith("holds"):
        verdict = decided(not lost, least)
        if verdict == "does not hold":
            verdict += ": not better than " + ", ".join(lost)
    texts = [f"{name} {value:.2f} (p {p:.3f}, {scenes} scenes)" for name, (value, p, scenes) in compared.items()]
    chance = "0.50" if measure == "auc" else f"{row_of(evidence, f'{measure}_chance', gate)['value']:.2f}"
    return Claim(
        f"Detector: {gate} locates crater pixels better than nulls and attribution methods ({LOCALISATION[measure]})",
        f"{row['value']:.2f}",
        interval_text(row),
        ", ".join([f"chance {chance}", nulls.nulls, *texts]),
        verdict,
        "localisation_detect.png",
    )


def _paired(evidence: Evidence, measure: str, gate: str, name: str) -> tuple[float, float, int]:
    """Mean of an attribution method, p of the test that the gate is better, and the number of scenes."""
    rows = evidence.values[evidence.values["measure"] == measure]
    table = rows[rows["map"].isin([gate, name])].pivot_table(
        index=["scene_id", "frame_id"], columns="map", values="value", aggfunc="first"
    )
    if name not in table or gate not in table:
        return math.nan, math.nan, 0
    table = table.dropna()
    by_scene = (table[gate] - table[name]).groupby(level="scene_id").mean().to_numpy(np.float64)
    return float(table[name].mean()), unit_sign_flip_p(by_scene), len(by_scene)


def motion(evidence: Evidence, *, moving: bool) -> Claim:
    """The paper's claim on the sign of PCC4 - PCC3, for gates up to B_36 (`moving`) or from B_37 on."""
    rows = evidence.summary[(evidence.summary["measure"] == "pcc4_minus_pcc3") & (evidence.summary["kind"] == "gate")]
    number = rows["map"].str[2:].astype(int)
    rows = rows[number < STILL_FROM] if moving else rows[number >= STILL_FROM]
    fit = rows["value"] > 0 if moving else rows["value"] < 0
    nulls = evidence.differences[
        (evidence.differences["measure"] == "pcc4_minus_pcc3") & evidence.differences["map"].isin(rows["map"])
    ]
    medians = nulls.groupby("null", sort=False)["null_value"].median()
    verdict = decided(bool(fit.all()), scenes_of(rows))
    figure = f"{int(fit.sum())} of {len(rows)} gates; median difference {rows['value'].median():.2f}"
    if moving:
        tested = evidence.tested[
            (evidence.tested["measure"] == "pcc4_minus_pcc3") & evidence.tested["map"].isin(rows["map"])
        ]
        beating = int(tested["beats_all"].sum())
        figure += f"; {beating} beat every null"
        if verdict == "holds" and beating < len(rows):
            verdict = f"holds, but {len(rows) - beating} of {len(rows)} gates do not beat every null"
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


def removal_row(evidence: Evidence, *, higher_is_better: bool) -> pd.Series:
    """The row of `removal_summary` for the strongest gate and its filling with the lower ratio."""
    table = removal_summary(evidence.removal, higher_is_better)
    rows = table[table["map"] == evidence.strongest]
    return rows.iloc[int(np.argmin(rows["ratio"].fillna(-np.inf).to_numpy()))]


def relative_removal(evidence: Evidence, *, higher_is_better: bool) -> dict[str, Relative]:
    """`relative_harm` of the strongest gate, for its filling with the lower ratio to the stronger control."""
    how = removal_row(evidence, higher_is_better=higher_is_better)["how"]
    rng = np.random.default_rng(0)
    return relative_harm(evidence.removal, evidence.strongest, how, higher_is_better, rng)


def removal_claim(evidence: Evidence, task: str, unit: str, picture: str, *, higher_is_better: bool) -> Claim:
    """The claim that removing attended pixels does more harm than both controls and than removing edges.

    The figure is also stated relative to a perfect mask, if the labels give one.
    """
    row = removal_row(evidence, higher_is_better=higher_is_better)
    relative = relative_removal(evidence, higher_is_better=higher_is_better)
    words = {"control": "times the stronger control", PERFECT: "of what a perfect mask reaches"}
    words |= {name: "times edges" for name in relative if name.startswith("edge")}
    ratios = {words[name]: ratio for name, ratio in relative.items() if name in words and np.isfinite(ratio.value)}
    intervals = [
        f"{ratio.interval[0]:.2f} to {ratio.interval[1]:.2f} {name}" for name, ratio in ratios.items() if ratio.interval
    ]
    scenes = evidence.removal.loc[evidence.removal["before"].notna(), "scene_id"].nunique()
    if math.isnan(row["most"]):
        figure = "no image with a value"
    else:
        known = [f"{ratio.value:.2f} {name}" for name, ratio in ratios.items()]
        known += [] if "times the stronger control" in ratios else ["the stronger control does no harm"]
        figure = f"{row['most']:.3f}: {', '.join(known)} (filled by {row['how']}, the less favourable)"
    controls = [f"random {row['random']:.3f}", f"same shape elsewhere {row['shifted']:.3f}"]
    controls.append(f"least attended {row['least']:.3f}")
    table = removal_summary(evidence.removal, higher_is_better)
    for other in table[(table["how"] == row["how"]) & (table["map"] != evidence.strongest)].to_dict("records"):
        name = "perfect mask" if other["map"] == PERFECT else "edges"
        times = f" ({other['ratio']:.2f} times its control)" if np.isfinite(other["ratio"]) else ""
        controls.append(f"{name} {other['most']:.3f}{times}")
    edge = next((name for name in relative if name.startswith("edge")), None)
    tested = {"control": relative["control"].p} | ({"edges": relative[edge].p} if edge else {})
    lost = [name for name, p in tested.items() if not p < LEVEL]
    verdict = decided(not lost, scenes)
    return Claim(
        f"{task}: {_REMOVES} that {evidence.strongest} attends to hurts more than controls and edges ({unit})",
        figure,
        f"{', '.join(intervals)} ({scenes} scenes)" if intervals else f"none: {scenes} scenes",
        "-" if math.isnan(row["most"]) else ", ".join(controls),
        "does not beat: " + ", ".join(lost) if verdict == "does not hold" else verdict,
        picture,
    )


def forced_harm(evidence: Evidence, *, higher_is_better: bool) -> pd.DataFrame:
    """`forced_summary` of the network's gates."""
    return forced_summary(evidence.gates, higher_is_better, np.random.default_rng(0))


def forced_claim(evidence: Evidence, task: str, unit: str, picture: str, *, higher_is_better: bool) -> Claim:
    """The claim that the output gets worse if all gates are forced to their means."""
    harm = forced_harm(evidence, higher_is_better=higher_is_better)
    row = harm[harm["scope"] == ALL].iloc[0]
    return Claim(
        f"{task}: {_FORCES} (all gates forced to their means: {unit})",
        f"harm {row['value']:.3f}" if math.isfinite(row["value"]) else "-",
        f"{interval_text(row, 3)}, p {row['p']:.4f}" if math.isfinite(row["p"]) else "none: no scene with a value",
        "-",
        decided(row["p"] < LEVEL, scenes_of(row.to_frame().T)),
        picture,
    )


def single_gate_claim(evidence: Evidence, task: str, unit: str, picture: str, *, higher_is_better: bool) -> Claim:
    """The claim that the output gets worse if some gate alone is forced to its mean.

    p is corrected for the number of gates (Benjamini & Hochberg 1995).
    """
    harm = forced_harm(evidence, higher_is_better=higher_is_better)
    single = harm[harm["scope"].str.startswith("B_")]
    single = single.assign(adjusted=false_discovery_control(single["p"].fillna(1.0)))
    ordered = single.dropna(subset="value").sort_values("value", ascending=False, kind="stable")
    mattering = int(((single["adjusted"] < LEVEL) & (single["value"] > 0)).sum())
    listed = [f"{row['scope']} {row['value']:.3f} (p {row['adjusted']:.4f})" for row in ordered.to_dict("records")]
    more = f", {len(listed) - _LISTED_GATES} more" if len(listed) > _LISTED_GATES else ""
    largest = None if ordered.empty else ordered.iloc[0]
    return Claim(
        f"{task}: the pattern of a single mask matters (one gate forced to its mean: {unit})",
        f"{mattering} of {len(single)} gates"
        + ("" if largest is None else f"; largest harm {largest['value']:.3f} ({largest['scope']})"),
        "none: no scene with a value" if largest is None else interval_text(largest, 3),
        ", ".join(listed[:_LISTED_GATES]) + more if listed else "-",
        decided(mattering > 0, scenes_of(single)),
        picture,
    )
