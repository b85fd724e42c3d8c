"""Statements on the gates, each with its figure, interval, nulls, verdict and picture."""

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from perilune_train.evaluation.spread import MIN_UNITS
from perilune_train.explain.evidence.gates import ALL
from perilune_train.explain.evidence.removal import removal_summary
from perilune_train.explain.evidence.significance import BEATS, LEVEL, UNDECIDED, unit_sign_flip_p
from perilune_train.explain.evidence.tables import Evidence

STILL_FROM = 37
"""The paper: PCC4 is above PCC3 up to B_36, below from B_37."""
DEEP_GATES = tuple(f"B_4{k}" for k in (8,)) + tuple(f"B_5{k}" for k in (1, 2, 3, 4))
DEEP_ALIKE = 0.75
HARM_RATIO = 3.0
"""Removing attended pixels should hurt this many times as much as the stronger control."""
LEAST_DEVIATION = 0.02
"""A gate whose mask has a smaller standard deviation over pixels and images is called constant."""


@dataclass(frozen=True)
class Claim:
    """One statement; all fields are texts for a table."""

    claim: str
    """What is claimed, and by whom."""
    figure: str
    """The measured figure."""
    interval: str
    """Its 95 % interval over scenes, or why there is none."""
    nulls: str
    """The same figure of the nulls or controls."""
    verdict: str
    """holds, does not hold, or undecided, with the reason."""
    picture: str
    """File that shows it."""

    def plain(self) -> dict[str, str]:
        """The fields as plain data."""
        return asdict(self)


def detector_claims(found: Evidence, deviations: dict[str, float], guided: Collection[str] = ()) -> list[Claim]:
    """Claims on the detector; `deviations` are the standard deviations of the masks over pixels and images.

    `guided` are gates whose masks were trained to follow labels; the claims say so.
    """
    strongest = found.strongest
    follows = f"Detector: the mask of {strongest} follows craters"
    trained = ", as it was trained to" if strongest in guided else ""
    return [
        _against_nulls(found, "pcc1_craterness", strongest, follows + trained, "pcc_detect.png"),
        _against_nulls(
            found, "pcc1_partial", strongest, f"{follows} beyond brightness and gradient{trained}", "pcc_detect.png"
        ),
        _shallow(found),
        _deep_alike(found),
        _located(found),
        _removal(found, "Detector", "AP of a frame", higher_is_better=True),
        _forced(found, "Detector", "AP of a frame", higher_is_better=True),
        _constant("Detector", deviations, "masks_detect.png"),
    ]


def navigator_claims(found: Evidence, deviations: dict[str, float]) -> list[Claim]:
    """Claims on the stack navigator."""
    strongest = found.strongest
    return [
        _against_nulls(
            found,
            "pcc4",
            strongest,
            f"Navigator: both halves of the mask of {strongest} mark the same ground (PCC4)",
            "pcc_navigate.png",
        ),
        _motion(found, moving=True),
        _motion(found, moving=False),
        _removal(found, "Navigator", "position error of a pair, m", higher_is_better=False),
        _forced(found, "Navigator", "position error of a pair, m", higher_is_better=False),
        _constant("Navigator", deviations, "masks_navigate.png"),
    ]


def headline(claims: list[Claim]) -> str:
    """One sentence: whether the strongest shallow gate of each task beats every null."""
    parts = []
    for task in ("Detector", "Navigator"):
        first = next((one for one in claims if one.claim.startswith(task)), None)
        if first is not None:
            parts.append(f"{first.claim[len(task) + 2 :]}: {first.verdict} ({task.lower()})")
    return "; ".join(parts) + "."


def _decided(holds: bool, scenes: int) -> str:
    """The verdict on a statement that was measured over a number of scenes."""
    return UNDECIDED if scenes < MIN_UNITS else "holds" if holds else "does not hold"


def _scenes(rows: pd.DataFrame) -> int:
    """The number of scenes behind rows of a summary: 1 if their units are trajectories of one scene."""
    return int(rows["n_units"].min()) if len(rows) and (rows["unit"] == "scene").all() else 1


def _row(found: Evidence, measure: str, gate: str) -> pd.Series:
    own = found.summary[(found.summary["measure"] == measure) & (found.summary["map"] == gate)]
    return own.iloc[0]


def _interval(row: pd.Series) -> str:
    if math.isfinite(row["low"]) and math.isfinite(row["high"]):
        return f"{row['low']:.2f} to {row['high']:.2f} ({row['n_units']} units: {row['unit']})"
    return f"none: {row['n_units']} units ({row['unit']})"


def _null_means(found: Evidence, measure: str, gate: str) -> str:
    own = found.differences[(found.differences["measure"] == measure) & (found.differences["map"] == gate)]
    return ", ".join(f"{row.null} {row.null_value:.2f}" for row in own.itertuples())


def _against_nulls(found: Evidence, measure: str, gate: str, claim: str, picture: str) -> Claim:
    row = _row(found, measure, gate)
    tested = found.tested[(found.tested["measure"] == measure) & (found.tested["map"] == gate)]
    verdict = "undefined: no null has a value" if tested.empty else str(tested.iloc[0]["verdict"])
    verdict = f"holds: {BEATS}" if verdict == BEATS else verdict
    figure = f"{row['value']:.2f}" if math.isfinite(row["value"]) else "-"
    return Claim(claim, figure, _interval(row), _null_means(found, measure, gate), verdict, picture)


def _shallow(found: Evidence) -> Claim:
    own = found.tested[(found.tested["measure"] == "pcc1_craterness")]
    shallow = own[own["map"].str[2].isin(["1", "2", "3"])]
    beating = beating_gates(found, "pcc1_craterness")
    stages = [str(k) for k in (1, 2, 3) if any(block[2] == str(k) for block in beating)]
    verdict = "holds" if len(stages) == 3 else "does not hold"
    undecided = bool(shallow["verdict"].str.startswith("undecided").any())
    return Claim(
        "Detector: every stage up to stride 8 has a gate that beats every null (paper: shallow gates follow craters)",
        f"{len(beating)} of {len(shallow)} gates, stages {', '.join(stages) or 'none'}",
        "-",
        f"untrained, edge, contrast, brightness, other frame, permutation; Benjamini-Hochberg over {len(own)} gates",
        UNDECIDED if undecided else verdict,
        "pcc_detect.png",
    )


def _deep_alike(found: Evidence) -> Claim:
    gates = [gate for gate in DEEP_GATES if gate in set(found.summary["map"])]
    rows = [_row(found, "pcc2", gate) for gate in gates]
    values = [float(row["value"]) for row in rows]
    untrained = [_null_value(found, "pcc2", gate, "untrained") for gate in gates]
    holds = all(value > DEEP_ALIKE for value in values)
    trivial = holds and all(value > DEEP_ALIKE for value in untrained)
    verdict = _decided(holds, _scenes(pd.DataFrame(rows)))
    verdict = "holds, as in the untrained network" if verdict == "holds" and trivial else verdict
    return Claim(
        f"Paper: PCC2 of {', '.join(gates)} is above {DEEP_ALIKE}",
        ", ".join(f"{value:.2f}" for value in values),
        "; ".join(_interval(row) for row in rows[:1]),
        "untrained " + ", ".join(f"{value:.2f}" for value in untrained),
        verdict,
        "pcc_detect.png",
    )


def _null_value(found: Evidence, measure: str, gate: str, null: str) -> float:
    own = found.differences
    own = own[(own["measure"] == measure) & (own["map"] == gate) & (own["null"] == null)]
    return float(own["null_value"].iloc[0]) if len(own) else float("nan")


def _located(found: Evidence) -> Claim:
    own = found.summary[found.summary["measure"] == "auc"].set_index("map")["value"]
    methods = found.summary.loc[(found.summary["measure"] == "auc") & (found.summary["kind"] != "gate"), "map"]
    best = max((float(own[name]) for name in methods if math.isfinite(own[name])), default=math.nan)
    row = _row(found, "auc", found.strongest)
    holds = row["value"] > best
    return Claim(
        f"Detector: {found.strongest} locates crater pixels better than image maps and attribution methods (ROC-AUC)",
        f"{row['value']:.2f}",
        _interval(row),
        "chance 0.50, " + ", ".join(f"{name} {own[name]:.2f}" for name in methods),
        _decided(bool(holds), _scenes(row.to_frame().T)),
        "localisation_detect.png",
    )


def removal_row(found: Evidence, *, higher_is_better: bool) -> pd.Series:
    """Harm of removing the strongest gate's pixels (a row of `removal_summary`), by the less favourable filling."""
    table = removal_summary(found.removal, higher_is_better)
    own = table[table["map"] == found.strongest]
    return own.iloc[int(np.argmin(own["ratio"].fillna(-np.inf).to_numpy()))]


def beating_gates(found: Evidence, measure: str, stages: str = "123") -> list[str]:
    """Gates of some stages that beat every null in a measure, corrected for all 23 gates."""
    own = found.tested[(found.tested["measure"] == measure) & found.tested["beats_all"]]
    return own.loc[own["map"].str[2].isin(list(stages)), "map"].tolist()


def _removal(found: Evidence, task: str, unit: str, *, higher_is_better: bool) -> Claim:
    row = removal_row(found, higher_is_better=higher_is_better)
    controls = (
        f"random {row['random']:.3f}, same shape elsewhere {row['shifted']:.3f}, least attended {row['least']:.3f}"
    )
    scenes = found.removal["scene_id"].nunique()
    if math.isfinite(row["ratio"]):
        times = f"{row['ratio']:.1f} times the stronger control"
    else:
        times = "the stronger control does no harm, so there is no ratio"
    return Claim(
        f"{task}: removing the 20 % that {found.strongest} attends to hurts at least {HARM_RATIO:g} times as much as"
        f" a control ({unit})",
        f"{row['most']:.3f}; {times} (filled by {row['how']}, the less favourable)",
        f"none: ratio over {scenes} scenes",
        controls,
        _decided(math.isfinite(row["ratio"]) and row["ratio"] >= HARM_RATIO and row["most"] > 0, scenes),
        f"removal_{'detect' if task == 'Detector' else 'navigate'}.png",
    )


def _forced(found: Evidence, task: str, unit: str, *, higher_is_better: bool) -> Claim:
    change = (found.gates["before"] - found.gates["after"]) * (1 if higher_is_better else -1)
    harm = found.gates.assign(harm=change).groupby("scope", sort=False)["harm"].mean()
    single = harm[harm.index.str.startswith("B_")]
    every = found.gates.assign(harm=change)[found.gates["scope"] == ALL]
    scenes = every.groupby("scene_id")["harm"].mean().to_numpy()
    p = unit_sign_flip_p(scenes)
    return Claim(
        f"{task}: the pattern of the masks matters (all gates forced to their means: {unit})",
        f"harm {harm[ALL]:.3f}",
        f"{scenes.min():.3f} to {scenes.max():.3f} over {len(scenes)} scenes, p {p:.4f}",
        f"largest single gate {single.idxmax()} {single.max():.3f}; median gate {single.median():.3f}",
        _decided(p < LEVEL, len(scenes)),
        f"gates_{'detect' if task == 'Detector' else 'navigate'}.png",
    )


def _constant(task: str, deviations: dict[str, float], picture: str) -> Claim:
    least = min(deviations, key=lambda block: deviations[block])
    constant = [block for block, value in deviations.items() if value < LEAST_DEVIATION]
    return Claim(
        f"{task}: no gate is constant (standard deviation over pixels and images at least {LEAST_DEVIATION:g})",
        f"{len(constant)} of {len(deviations)} constant; least {deviations[least]:.3f} ({least})",
        "-",
        "-",
        "does not hold" if constant else "holds",
        picture,
    )


def _motion(found: Evidence, *, moving: bool) -> Claim:
    """PCC4 - PCC3 of the gates up to B_36, or of those from B_37 on."""
    own = found.summary[(found.summary["measure"] == "pcc4_minus_pcc3") & (found.summary["kind"] == "gate")]
    number = own["map"].str[2:].astype(int)
    own = own[number < STILL_FROM] if moving else own[number >= STILL_FROM]
    fit = own["value"] > 0 if moving else own["value"] < 0
    gates = "up to B_36" if moving else "from B_37 on"
    edge = found.differences[
        (found.differences["measure"] == "pcc4_minus_pcc3") & (found.differences["null"] == "edge")
    ]
    return Claim(
        f"Paper: PCC4 is {'above' if moving else 'below'} PCC3 {gates}",
        f"{int(fit.sum())} of {len(own)} gates; median difference {own['value'].median():.2f}",
        "by gate in pcc_navigate.png",
        f"edge map {edge['null_value'].mean():.2f}" if len(edge) else "-",
        _decided(bool(fit.all()), _scenes(own)),
        "pcc_navigate.png",
    )
