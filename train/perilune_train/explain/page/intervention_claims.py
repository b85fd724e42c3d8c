"""Claims on what the output loses if gates are forced to their means, or pixels are removed."""

import math

import numpy as np
import pandas as pd

from perilune_train.explain.evidence.gates import ALL
from perilune_train.explain.evidence.removal import removal_summary
from perilune_train.explain.evidence.significance import LEVEL, unit_sign_flip_p
from perilune_train.explain.evidence.tables import Evidence
from perilune_train.explain.page.claim import Claim, decided

HARM_RATIO = 3.0
"""Removing attended pixels should hurt this many times as much as the stronger control."""


def removal_row(found: Evidence, *, higher_is_better: bool) -> pd.Series:
    """Harm of removing the strongest gate's pixels (a row of `removal_summary`), by the less favourable filling."""
    table = removal_summary(found.removal, higher_is_better)
    own = table[table["map"] == found.strongest]
    return own.iloc[int(np.argmin(own["ratio"].fillna(-np.inf).to_numpy()))]


def removal_claim(found: Evidence, task: str, unit: str, picture: str, *, higher_is_better: bool) -> Claim:
    """Whether removing attended pixels hurts HARM_RATIO times as much as the stronger control."""
    row = removal_row(found, higher_is_better=higher_is_better)
    controls = (
        f"random {row['random']:.3f}, same shape elsewhere {row['shifted']:.3f}, least attended {row['least']:.3f}"
    )
    scenes = found.removal.loc[found.removal["before"].notna(), "scene_id"].nunique()
    if math.isnan(row["most"]):
        times = "no image with a value"
    elif math.isfinite(row["ratio"]):
        times = f"{row['ratio']:.1f} times the stronger control"
    else:
        times = "the stronger control does no harm, so there is no ratio"
    return Claim(
        f"{task}: removing the 20 % that {found.strongest} attends to hurts at least {HARM_RATIO:g} times as much as"
        f" a control ({unit})",
        f"{row['most']:.3f}; {times} (filled by {row['how']}, the less favourable)",
        f"none: ratio over {scenes} scenes",
        controls,
        decided(math.isfinite(row["ratio"]) and row["ratio"] >= HARM_RATIO and row["most"] > 0, scenes),
        picture,
    )


def forced_harm(found: Evidence, *, higher_is_better: bool) -> dict[str, float]:
    """Mean harm over frames of forcing each gate, each stage and all gates to their means, by name."""
    harm = _harms(found, higher_is_better).groupby("scope", sort=False)["harm"].mean()
    return {str(scope): float(value) for scope, value in harm.items()}


def forced_claim(found: Evidence, task: str, unit: str, picture: str, *, higher_is_better: bool) -> Claim:
    """Whether the output gets worse if all gates are forced to their means."""
    harm = forced_harm(found, higher_is_better=higher_is_better)
    single = pd.Series({scope: value for scope, value in harm.items() if scope.startswith("B_")}).dropna()
    table = _harms(found, higher_is_better)
    by_scene = table[table["scope"] == ALL].groupby("scene_id")["harm"].mean()
    scenes = by_scene.dropna().to_numpy(np.float64)
    p = unit_sign_flip_p(scenes)
    interval = "none: no scene with a value"
    if len(scenes):
        interval = f"smallest and largest of {len(scenes)} scenes: {scenes.min():.3f} to {scenes.max():.3f}, p {p:.4f}"
    controls = f"largest single gate {single.idxmax()} {single.max():.3f}; median gate {single.median():.3f}"
    return Claim(
        f"{task}: the pattern of the masks matters (all gates forced to their means: {unit})",
        f"harm {harm[ALL]:.3f}",
        interval,
        controls if len(single) else "-",
        decided(p < LEVEL, len(scenes)),
        picture,
    )


def _harms(found: Evidence, higher_is_better: bool) -> pd.DataFrame:
    change = (found.gates["before"] - found.gates["after"]) * (1 if higher_is_better else -1)
    return found.gates.assign(harm=change)
