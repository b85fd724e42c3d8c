"""The paper's claims, each with what was measured here and whether it holds."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from perilune_train.evaluation.metrics_file import Metrics
from perilune_train.evaluation.spread import MIN_UNITS, read_spread
from perilune_train.paper.claimed import (
    DEEP_ALIKE,
    DEEP_ALIKE_GATES,
    DETECTION,
    MODERATE,
    MOTION_GATES,
    NAVIGATION,
    SHALLOW_CRATER_GATES,
    STILL_GATES,
)
from perilune_train.paper.runs import PaperRuns

Answer = Literal["holds", "does not hold", "within the spread", "undecided", "not measured"]


@dataclass(frozen=True)
class Verdict:
    """One claim."""

    claim: str
    """What the paper says."""
    claimed: str
    """The paper's figures."""
    measured: str
    """Ours, with intervals where there are five units or more."""
    answer: Answer
    """within the spread: the difference has the claimed sign, but the intervals overlap, or there are none. undecided:
    masks were measured over fewer than five scenes."""


def verdicts(runs: PaperRuns, large_width_ratio: float | None) -> list[Verdict]:
    """All claims in the order of the paper. Raises UserError if a run is not finished.

    `large_width_ratio` is the width of the large craters that attention-YOLOv3 finds, divided by the true one.
    """
    detection, navigation, explained = runs.detection(), runs.navigation(), runs.explanation()
    plain, attended = detection.values()
    found = [_detection(key, name, plain, attended) for key, name in _FIGURES.items()]
    small = [f"test/radius_{low}_px/ap50_paper" for low in ("2_3", "3_5")]
    found += [
        _compared(
            f"attention detects small craters ({key.split('/')[1][7:-3].replace('_', ' to ')} px) better",
            "no figure",
            (plain, key),
            (attended, key),
            higher=True,
        )
        for key in small
    ]
    found.append(_large_craters(large_width_ratio))
    bare, gated = navigation.values()
    for name, key, field in _NAVIGATION:
        claimed = " against ".join(f"{one[field]:g}" for one in reversed(NAVIGATION.values()))
        found.append(_compared(name, claimed, (bare, key), (gated, key), higher=False))
    found.append(_as_fast(bare, gated))
    found += _gates(explained)
    return found


_ZERO = 1e-4
"""Errors below this are those of a constant: without attitude noise the camera does not rotate."""
_PIXELS = {
    "_all_pixels": "all pixels, 0 where the other half is not seen",
    "": "pixels that both halves see",
}
"""PCC3 and PCC4 by the pixels that they are computed over."""
_FIGURES = {"precision": "precision", "recall": "recall", "ap50_paper": "AP", "f1": "F1"}
_NAVIGATION = (
    (
        "attention lowers the position RMSE (per component)",
        "test/position_rmse_per_component_m",
        "position_m",
    ),
    (
        "attention lowers the orientation RMSE (per component)",
        "test/orientation_rmse_per_component_deg",
        "orientation_deg",
    ),
)


def _detection(key: str, name: str, plain: Metrics, attended: Metrics) -> Verdict:
    claimed = f"{DETECTION['attention-YOLOv3'][key]:.4f} against {DETECTION['YOLOv3'][key]:.4f}"
    return _compared(
        f"attention raises {name}", claimed, (plain, f"test/{key}"), (attended, f"test/{key}"), higher=True
    )


def _compared(
    claim: str, claimed: str, without: tuple[Metrics, str], with_: tuple[Metrics, str], *, higher: bool
) -> Verdict:
    """Compare a figure of the network with attention with that of the one without."""
    values = [metrics.get(key) for metrics, key in (with_, without)]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        return Verdict(claim, claimed, "-", "not measured")
    ours, other = (float(value) for value in values if isinstance(value, int | float))
    if max(abs(ours), abs(other)) < _ZERO:
        return Verdict(claim, claimed, "the truth is 0 in all pairs, and both networks know it", "not measured")
    spreads = [read_spread(metrics, key) for metrics, key in (with_, without)]
    places = max(0, 3 - math.floor(math.log10(max(abs(other), 1e-12)))) if other else 3
    measured = f"{_text(ours, spreads[0].interval, places)} against {_text(other, spreads[1].interval, places)}"
    if (ours > other) != higher or ours == other:
        return Verdict(claim, claimed, measured, "does not hold")
    first, second = spreads[0].interval, spreads[1].interval
    apart = first and second and (first[0] > second[1] if higher else first[1] < second[0])
    return Verdict(claim, claimed, measured, "holds" if apart else "within the spread")


def _text(value: float, interval: tuple[float, float] | None, places: int) -> str:
    limits = f" ({interval[0]:.{places}f} to {interval[1]:.{places}f})" if interval else ""
    return f"{value:.{places}f}{limits}"


def _large_craters(ratio: float | None) -> Verdict:
    claim = "with attention, boxes of large craters (radius 20 to 50 px) are slightly smaller than the truth"
    if ratio is None:
        return Verdict(claim, "no figure", "no such crater was found", "not measured")
    return Verdict(claim, "no figure", f"median width {ratio:.3f} of it", "holds" if ratio < 1 else "does not hold")


def _as_fast(bare: Metrics, gated: Metrics) -> Verdict:
    key, claim, claimed = "test/ms_per_single_pair", "a pair takes as long with attention as without", "0.22 s both"
    without, with_ = bare.get(key), gated.get(key)
    if not isinstance(without, int | float) or not isinstance(with_, int | float):
        return Verdict(claim, claimed, "-", "not measured")
    measured = f"{with_ / 1e3:.3f} s against {without / 1e3:.3f} s on this machine"
    return Verdict(claim, claimed, measured, "holds" if with_ < 1.05 * without else "does not hold")


def _gates(explained: Metrics) -> list[Verdict]:
    """Claims on attention gates, with the range of each null over the same gates.

    Single figures without an interval, so each is a plain comparison; over fewer than five scenes it decides nothing.
    """

    def of(measure: str, gates: Sequence[str]) -> dict[str, float]:
        found = {gate: explained.get(f"{measure}/{gate}") for gate in gates}
        return {gate: float(value) for gate, value in found.items() if isinstance(value, int | float)}

    def nulls(measure: str, gates: Sequence[str]) -> str:
        found: dict[str, list[float]] = {}
        for gate in gates:
            prefix = f"{measure}_null/{gate}/"
            for key, value in explained.items():
                if key.startswith(prefix) and isinstance(value, float):
                    found.setdefault(key.removeprefix(prefix), []).append(value)
        ranges = ", ".join(f"{null} {min(values):.2f} to {max(values):.2f}" for null, values in found.items())
        return f"; nulls: {ranges}" if ranges else ""

    def judged(
        claim: str,
        claimed: str,
        gates: Sequence[str],
        values: dict[str, float],
        ok: Callable,
        null: str,
        scenes: str,
    ) -> Verdict:
        if not values:
            return Verdict(claim, claimed, "-", "not measured")
        fit = [gate for gate, value in values.items() if ok(value)]
        listed = ", ".join(f"{gate} {value:.2f}" for gate, value in values.items())
        n_scenes = explained.get(scenes)
        few = not isinstance(n_scenes, int) or n_scenes < MIN_UNITS
        measured = f"{len(fit)} of {len(gates)}: {listed}{nulls(null, gates)}"
        return Verdict(
            claim,
            claimed,
            f"{measured}; {n_scenes if isinstance(n_scenes, int) else 'unknown number of'} scenes",
            "undecided" if few else "holds" if len(fit) == len(gates) else "does not hold",
        )

    def difference(gates: Sequence[str], pixels: str) -> dict[str, float]:
        still, moved = of(f"pcc3{pixels}", gates), of(f"pcc4{pixels}", gates)
        return {gate: moved[gate] - still[gate] for gate in gates if gate in still and gate in moved}

    craters = of("pcc1_background", SHALLOW_CRATER_GATES)
    deep = of("pcc2", DEEP_ALIKE_GATES)
    return [
        judged(
            f"PCC1 of {' and '.join(SHALLOW_CRATER_GATES)} is moderate (here: at least {MODERATE} in size)",
            "figure only",
            SHALLOW_CRATER_GATES,
            craters,
            lambda value: abs(value) >= MODERATE,
            "pcc1_background",
            "scenes",
        ),
        judged(
            f"PCC2 of {', '.join(DEEP_ALIKE_GATES)} is above {DEEP_ALIKE}",
            f"> {DEEP_ALIKE}",
            DEEP_ALIKE_GATES,
            deep,
            lambda value: value > DEEP_ALIKE,
            "pcc2",
            "scenes",
        ),
        *(
            judged(
                f"PCC4 is above PCC3 for {', '.join(MOTION_GATES)} (PCC4 - PCC3, {words})",
                "> 0",
                MOTION_GATES,
                difference(MOTION_GATES, pixels),
                lambda value: value > 0,
                "" if pixels else "pcc4_minus_pcc3",
                "pair_scenes",
            )
            for pixels, words in _PIXELS.items()
        ),
        *(
            judged(
                f"PCC3 is above PCC4 from B_37 on (PCC4 - PCC3, {words})",
                "< 0",
                STILL_GATES,
                difference(STILL_GATES, pixels),
                lambda value: value < 0,
                "" if pixels else "pcc4_minus_pcc3",
                "pair_scenes",
            )
            for pixels, words in _PIXELS.items()
        ),
    ]
