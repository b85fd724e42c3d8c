"""Claims of a causal run: figures, intervals, placebos and verdicts.

Scenes are independent, but views of one scene are not. A verdict is therefore based on the mean change of each scene,
tested by sign flips over scenes. Intervals come from a bootstrap over scenes and do not affect verdicts.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from perilune_train.explain.causal.pictures import scene_interval
from perilune_train.explain.evidence.significance import LEVEL, unit_sign_flip_p
from perilune_train.records.spread import MIN_UNITS

NO_PLACEBO = "undecided: no placebo"
_BOTH_WAYS = MIN_UNITS + 1
"""Smallest number of scenes for a two-sided test. With five scenes, p is at least 2 / 32, which is above `LEVEL`."""
_FEW = 0.1
"""The share of craters detected after removal must be below this fraction of the share detected before removal."""
_VIEW = ["crater", "scene_id", "frame_id"]
_VERSIONS = ["factual", "rendered", "inpainted", "placebo"]


@dataclass(frozen=True)
class Tested:
    """A claim and the p values of its tests."""

    claim: dict[str, str]
    """claim, figure, interval, nulls, verdict and picture, as in claims.json."""
    p: float
    """p of the change; NaN with too few scenes."""
    p_placebo: float = float("nan")
    """p of the change beyond the placebo's change; NaN with too few scenes or without a placebo."""


def reaction_claim(effects: pd.DataFrame, gates: pd.DataFrame, gate: str) -> Tested:
    """The claim that a gate reacts to single craters.

    `effects` is the table of `mask_effects`, `gates` the table of `by_gate`. Two tests must pass:

    - The mean change is not 0. The change may have either sign, so p is two-sided.
    - The change is larger in magnitude than the placebo's change, paired over the views that have both. The change is
      multiplied by the sign of its mean; then change - placebo and change + placebo are tested, and the larger p
      counts.
    """
    views = _views(effects[effects["map"] == gate], "change")
    changed = _scene_means(views["rendered"], views)
    sign = -1.0 if changed.sum() < 0 else 1.0
    effect = sign * views["rendered"]
    beyond = [_scene_means(effect + other * views["placebo"], views) for other in (-1, 1)]
    p = _p(sign * changed, both_ways=True)
    p_placebo = float(np.max([_p(effect, both_ways=True) for effect in beyond]))
    rows = gates[gates["map"] == gate].set_index("version").reindex(_VERSIONS)
    mean = {str(version): float(value) for version, value in rows["change"].items()}
    low, high = ({str(version): float(value) for version, value in rows[end].items()} for end in ("low", "high"))
    empty = _text(mean["placebo"])
    if np.isfinite(low["placebo"]):
        empty += f" ({low['placebo']:.2f} to {high['placebo']:.2f})"
    claim = {
        "claim": f"Detector: {gate} reacts to single craters (mask with - without one, deviations of the gate)",
        "figure": _text(mean["rendered"]),
        "interval": _interval((low["rendered"], high["rendered"]), len(changed), p, p_placebo),
        "nulls": f"crater inpainted {_text(mean['inpainted'])}; empty ground inpainted {empty}",
        "verdict": _verdict(len(changed), len(beyond[0]), _BOTH_WAYS, max(p, p_placebo) < LEVEL),
        "picture": "gates_causal.png",
    }
    return Tested(claim, p, p_placebo)


def detection_claim(effects: pd.DataFrame, rng: np.random.Generator) -> Tested:
    """The claim that the detector finds a crater because of the crater's appearance.

    `effects` is the table of `with_found`. Three conditions must hold; the first two are one-sided tests:

    - Craters are detected more often before removal than after removal.
    - Craters are detected more often when other ground is inpainted than after removal.
    - The share detected after removal is below a tenth of the share detected before removal.
    """
    views = _views(effects, "found")
    lost = views["factual"] - views["rendered"]
    by_scene = _scene_means(lost, views)
    beyond = _scene_means(views["placebo"] - views["rendered"], views)
    p, p_placebo = _p(by_scene), _p(beyond)
    share = views[_VERSIONS].mean()
    holds = max(p, p_placebo) < LEVEL and share["rendered"] < _FEW * share["factual"]
    claim = {
        "claim": "The detector finds a crater because of the crater: found with it, not without it",
        "figure": f"{_text(share['factual'])} with, {_text(share['rendered'])} without",
        "interval": "difference " + _interval(_ends(lost, views, rng), len(by_scene), p, p_placebo),
        "nulls": f"inpainted {_text(share['inpainted'])}, other ground inpainted {_text(share['placebo'])}",
        "verdict": _verdict(len(by_scene), len(beyond), MIN_UNITS, bool(holds)),
        "picture": "detections_causal.png",
    }
    return Tested(claim, p, p_placebo)


def pose_claim(effects: pd.DataFrame, rng: np.random.Generator) -> Tested:
    """The claim that removing craters increases the navigator's error.

    `effects` is the table of `pose_effects`. The test is one-sided. No placebo is needed, because both versions are
    rendered.
    """
    before, after, moved_m = (float(np.sqrt((effects[name] ** 2).mean())) for name in ("before", "after", "moved_m"))
    harm = effects["after"] - effects["before"]
    by_scene = _scene_means(harm, effects)
    p = _p(by_scene)
    claim = {
        "claim": "Navigator: single craters matter (position error of a step without the removed craters)",
        "figure": f"r.m.s. {before:.3f} m with, {after:.3f} m without; estimates move by {moved_m:.3f} m",
        "interval": "mean increase " + _interval(_ends(harm, effects, rng), len(by_scene), p, unit=" m", digits=3),
        "nulls": "-",
        "verdict": _verdict(len(by_scene), None, MIN_UNITS, p < LEVEL),
        "picture": "before_after_causal.png",
    }
    return Tested(claim, p)


def _views(effects: pd.DataFrame, value: str) -> pd.DataFrame:
    """One row per view of a crater: its ids, and `value` in a column for each version (NaN without a value)."""
    table = effects.pivot(index=_VIEW, columns="version", values=value)
    return table.reindex(columns=_VERSIONS).reset_index()


def _scene_means(values: pd.Series, rows: pd.DataFrame) -> NDArray[np.float64]:
    """Mean (S,) of the values (N,) of each scene, without NaN; `rows` (N) has the column scene_id.

    Scenes without finite values are left out.
    """
    known = values[np.isfinite(values)]
    return known.groupby(rows.loc[known.index, "scene_id"]).mean().to_numpy(np.float64)


def _p(by_scene: NDArray[np.float64], *, both_ways: bool = False) -> float:
    """p of a mean above 0, by sign flips over scenes; NaN with too few scenes.

    `both_ways` doubles p, because the sign was chosen on these scenes.
    """
    if len(by_scene) < (_BOTH_WAYS if both_ways else MIN_UNITS):
        return float("nan")
    p = unit_sign_flip_p(by_scene)
    return min(1.0, 2 * p) if both_ways else p


def _ends(values: pd.Series, rows: pd.DataFrame, rng: np.random.Generator) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    known_rows = rows.loc[known.index]
    return scene_interval(known.to_numpy(), known_rows["scene_id"].tolist(), known_rows["frame_id"].tolist(), rng)


def _verdict(n_scenes: int, n_placebo: int | None, needed: int, holds: bool) -> str:
    """The verdict as text. `n_placebo` is the number of scenes with a placebo; None if the claim has no placebo."""
    if n_scenes < needed:
        return f"undecided: fewer than {needed} scenes"
    if n_placebo == 0:
        return NO_PLACEBO
    if n_placebo is not None and n_placebo < needed:
        return f"undecided: fewer than {needed} scenes with a placebo"
    return "holds" if holds else "does not hold"


def _interval(
    ends: tuple[float, float], n_scenes: int, p: float, p_placebo: float = float("nan"), unit: str = "", digits: int = 2
) -> str:
    """Text of a claim's interval: ends of the bootstrap interval, number of scenes, and p of the sign flips."""
    low, high = (f"{end:.{digits}f}" for end in ends)
    parts = [f"{low} to {high}{unit} ({n_scenes} scenes)" if np.isfinite(ends[0]) else "none: fewer than 5 scenes"]
    parts += [f"p {p:.4f}"] if np.isfinite(p) else []
    parts += [f"against the placebo p {p_placebo:.4f}"] if np.isfinite(p_placebo) else []
    return ", ".join(parts)


def _text(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "none"
