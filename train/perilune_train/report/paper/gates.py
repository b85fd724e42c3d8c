"""The paper's claims about attention gates, and PCC1 to PCC4 of our gates with their nulls."""

from collections.abc import Callable, Sequence

from perilune_train.records.markdown import table
from perilune_train.records.metrics_file import Metrics
from perilune_train.records.spread import MIN_UNITS
from perilune_train.report.paper.claimed import (
    DEEP_ALIKE,
    DEEP_ALIKE_GATES,
    MODERATE,
    MOTION_GATES,
    SHALLOW_CRATER_GATES,
    STILL_GATES,
)
from perilune_train.report.paper.rule import Answer, Verdict

_PIXELS = {
    "_all_pixels": "all pixels, 0 where the other half is not seen",
    "": "pixels that both halves see",
}
"""Pixels over which PCC3 and PCC4 are computed, by the suffix of their keys."""
_CORRELATIONS = {
    "pcc1_craterness": "PCC1: mask and craters",
    "pcc2": "PCC2: masks of two frames",
    "pcc3": "PCC3: halves",
    "pcc4": "PCC4: halves, one moved by the true motion",
    "pcc4_minus_pcc3": "PCC4 - PCC3",
}


def gate_verdicts(explained: Metrics) -> list[Verdict]:
    """Verdicts on the paper's claims about gates, from the metrics of an explain run.

    A claim names some gates. The claim holds if it is true for all of them, does not hold if it is true for none of
    them, and is open in all other cases. The figures of gates have no intervals, so every claim is open with fewer than
    `MIN_UNITS` scenes.
    """
    shallow = f"PCC1 of {' and '.join(SHALLOW_CRATER_GATES)} is moderate (here: at least {MODERATE} in size)"
    deep = f"PCC2 of {', '.join(DEEP_ALIKE_GATES)} is above {DEEP_ALIKE}"
    moved = f"PCC4 is above PCC3 for {', '.join(MOTION_GATES)}"
    still = "PCC3 is above PCC4 from B_37 on"
    craters, alike = _of(explained, "pcc1_background", SHALLOW_CRATER_GATES), _of(explained, "pcc2", DEEP_ALIKE_GATES)
    verdicts = [
        _judged(explained, (shallow, "figure only"), craters, lambda value: abs(value) >= MODERATE, "pcc1_background"),
        _judged(explained, (deep, f"> {DEEP_ALIKE}"), alike, lambda value: value > DEEP_ALIKE, "pcc2"),
    ]
    for claim, figure, ok, gates in (
        (moved, "> 0", _is_positive, MOTION_GATES),
        (still, "< 0", _is_negative, STILL_GATES),
    ):
        for pixels, words in _PIXELS.items():
            pcc4, pcc3 = (_of(explained, f"{measure}{pixels}", gates) for measure in ("pcc4", "pcc3"))
            difference = {gate: pcc4[gate] - pcc3[gate] for gate in pcc4 if gate in pcc3}
            text = f"{claim} (PCC4 - PCC3, {words})", figure
            null = "" if pixels else "pcc4_minus_pcc3"
            verdicts.append(_judged(explained, text, difference, ok, null))
    return verdicts


def _is_positive(value: float) -> bool:
    return value > 0


def _is_negative(value: float) -> bool:
    return value < 0


def _of(explained: Metrics, measure: str, gates: Sequence[str]) -> dict[str, float]:
    values = {gate: explained.get(f"{measure}/{gate}") for gate in gates}
    return {gate: float(value) for gate, value in values.items() if isinstance(value, int | float)}


def _judged(
    explained: Metrics, claim: tuple[str, str], values: dict[str, float], ok: Callable[[float], bool], null: str
) -> Verdict:
    """Verdict on a claim (text, the paper's figure) from the value of each gate.

    `null` is the measure whose nulls are listed; an empty string lists none.
    """
    if not values:
        return Verdict(*claim, "-", "-", "not measured")
    scenes = explained.get("pair_scenes" if "PCC4" in claim[0] else "scenes")
    fit = sum(map(ok, values.values()))
    few = not isinstance(scenes, int) or scenes < MIN_UNITS
    answer: Answer = "open"
    if not few and fit in (0, len(values)):
        answer = "holds" if fit else "does not hold"
    listed = ", ".join(f"{gate} {value:.2f}" for gate, value in values.items())
    nulls = f"; nulls: {_nulls(explained, null, values)}" if null and _nulls(explained, null, values) else ""
    counted = f"{scenes if isinstance(scenes, int) else 'unknown number of'} scene{'s' * (scenes != 1)}"
    return Verdict(*claim, f"{fit} of {len(values)}: {listed}{nulls}; {counted}", "one training run", answer)


def gate_table(explained: Metrics) -> list[str]:
    """Table of the ranges of PCC1 to PCC4 over all gates, and of their nulls, as lines of Markdown."""
    rows = []
    for measure, title in _CORRELATIONS.items():
        names = [key.removeprefix(f"{measure}/") for key in explained if key.startswith(f"{measure}/B_")]
        gates = _of(explained, measure, [name for name in names if not name.endswith(("_low", "_high"))])
        if not gates:
            continue
        # Leave out gates without nulls, which lack this key.
        beats = [bool(value) for gate in gates if (value := explained.get(f"{measure}_beats_nulls/{gate}")) is not None]
        beating = f"{sum(beats)} of {len(beats)}" if beats else "-"
        rows.append([title, _range(list(gates.values())), _nulls(explained, measure, gates) or "-", beating])
    return table(["correlation", "gates", "nulls", "gates that beat every null"], rows)


def _nulls(explained: Metrics, measure: str, gates: dict[str, float]) -> str:
    """Range of each null over the gates, as text; empty if the gates have no nulls."""
    nulls: dict[str, list[float]] = {}
    for gate in gates:
        prefix = f"{measure}_null/{gate}/"
        for key, value in explained.items():
            if key.startswith(prefix) and isinstance(value, float):
                nulls.setdefault(key.removeprefix(prefix), []).append(value)
    return ", ".join(f"{null} {_range(values)}" for null, values in nulls.items())


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"
